"""Sheets: rasters on a plane that are computed tile by tile."""
