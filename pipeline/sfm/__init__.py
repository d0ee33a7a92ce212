"""From photos to cameras: pairs, keypoints, matches, mapping, lenses; what the stages and the ladder share."""
