"""A splat in memory: Gaussians, spherical harmonics, the scene and its moments."""
