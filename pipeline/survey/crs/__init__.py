"""Coordinate reference systems, geodesy, and the frames between a model and the earth."""
