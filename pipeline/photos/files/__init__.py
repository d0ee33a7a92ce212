"""The photo folder: which files are photos, their names, formats and companions, and the checked list."""
