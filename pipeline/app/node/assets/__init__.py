"""What a client downloads of a finished run: files by fixed names, and all.zip."""
