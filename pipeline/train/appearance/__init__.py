"""What differs between photos and is not the scene: exposure, sky, and what moves."""
