"""What a reconstruction consists of: the view graph of photos and verified pairs, the sparse model and its parts."""
