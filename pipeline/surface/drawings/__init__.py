"""Drawings: their elements, DXF files and pictures."""
