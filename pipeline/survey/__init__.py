"""Surveying: coordinate reference systems, frames, control points and photo positions, and the model's accuracy."""
