"""Cameras, similarities and points: the geometry that everything else stands on."""
