"""Clouds and meshes from depth maps."""
