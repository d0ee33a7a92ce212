"""Depth maps of photos as the sources of all surfaces: points, visibility, colours and exposures."""
