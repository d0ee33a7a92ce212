"""Sections, volumes and lengths measured on the surface model."""
