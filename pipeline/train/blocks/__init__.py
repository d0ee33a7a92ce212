"""Scenes larger than memory, cut into blocks of ground that are trained one after the other and merged."""
