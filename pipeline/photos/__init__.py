"""Photos: their metadata, the checked photo list, and the undistorted dataset."""
