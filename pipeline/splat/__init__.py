"""The splat: Gaussians, their file formats, the panorama behind them, and image similarity metrics."""
