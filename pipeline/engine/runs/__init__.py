"""A run: its folder, lock, artifacts, workers, and the walk along its stages."""
