"""The bundle adjustment of tie points, positions and control: observations, lens, covariances."""
