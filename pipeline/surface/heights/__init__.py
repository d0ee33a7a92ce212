"""Heights over the ground plan: the surface model and its contours."""
