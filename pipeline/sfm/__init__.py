"""Structure from motion: pair selection, keypoints, matching, mapping, lens calibration and the recovery ladder."""
