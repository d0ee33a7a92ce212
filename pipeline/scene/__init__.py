"""What is reconstructed: cameras, photos, Gaussians, frames and the measures of their quality."""
