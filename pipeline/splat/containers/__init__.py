"""Containers of splat formats, from untrusted bytes: PLY, glTF, SPZ, archives, palettes."""
