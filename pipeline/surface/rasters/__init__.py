"""Rasters: their grids, tiles and files."""
