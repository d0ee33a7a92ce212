"""How good a splat is: image metrics, and free space that must be empty."""
