"""Rendering a model as it was trained, and measuring its images."""
