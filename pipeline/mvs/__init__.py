"""Depths of photos by many views."""
