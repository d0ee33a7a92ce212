"""Façades: walls, their openings, elevations and drawings."""
