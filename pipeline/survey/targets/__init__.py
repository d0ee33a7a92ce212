"""Targets on the ground found in the photos, and which surveyed point each is."""
