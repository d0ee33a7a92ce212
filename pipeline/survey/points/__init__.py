"""Surveyed points and their marks in photos."""
