"""Pixels: the undistorted dataset, its images at any size, resampling."""
