"""Cameras, similarity transforms and points: the geometry that everything else builds on."""
