"""Runs the pipeline: stages, artifacts, configuration, events. No tensors, no photogrammetry."""
