"""What surveyors are handed besides the splat: surface model, orthophoto, contours, clouds, and their files."""
