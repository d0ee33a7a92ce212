"""Photos: what their metadata say, the checked list, and the undistorted dataset."""
