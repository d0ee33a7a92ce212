"""Films: a camera's way through a scene, and the file that it becomes."""
