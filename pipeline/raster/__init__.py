"""The rasterizer: from Gaussians to images, and back to gradients."""
