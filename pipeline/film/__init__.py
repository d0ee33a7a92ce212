"""Films: a camera path through a scene, and the video file made from it."""
