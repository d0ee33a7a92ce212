"""What surveyors open: rasters, contours and clouds in the run's CRS."""
