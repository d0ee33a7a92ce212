"""Splat file formats: one module per format with ``read(path) -> Scene`` or ``write(path, scene)``, and their list."""
