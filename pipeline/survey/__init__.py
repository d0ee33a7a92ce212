"""Surveying: coordinate systems, frames, control and positions, and how well a model lies."""
