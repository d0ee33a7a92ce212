"""Levels of detail: merged Gaussians, and the tiles and streams that show them."""
