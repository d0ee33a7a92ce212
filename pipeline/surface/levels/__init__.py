"""Products in levels of detail: point clouds, maps and meshes that viewers load piece by piece."""
