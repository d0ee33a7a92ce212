"""Edits finished splats before delivery: clean, crop, move, merge, reduce."""
