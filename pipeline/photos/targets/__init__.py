"""Survey targets in one photo, with sub-pixel centres."""
