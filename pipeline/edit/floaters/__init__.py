"""What in a splat is not part of the scene: floaters, haze, and what no photo supports."""
