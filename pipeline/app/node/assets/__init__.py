"""What a node hands back of a finished run: `all.zip` in the layout that ODM's clients know, and single files of it."""
