"""What lies behind the Gaussians: sky masks, the panorama and its dome."""
