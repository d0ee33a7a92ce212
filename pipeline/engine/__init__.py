"""Runs the line: stages, artifacts, configuration, events. No tensors, no photogrammetry."""
