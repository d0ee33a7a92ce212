"""The rasterizer: Gaussians to pictures, and back to gradients."""
