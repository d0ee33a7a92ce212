"""Splats as they are handed over: cleaned, cut, moved, merged, reduced."""
