"""Multi-view stereo: depth maps and dense points from photos."""
