"""Survey products besides the splat: surface model, orthophoto, contours, point clouds, and their files."""
