"""Ground: which of a surface model is terrain, the terrain model that follows from it, and classes of points."""
