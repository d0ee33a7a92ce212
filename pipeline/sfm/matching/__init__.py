"""Keypoints and descriptors of photos, and verified matches of pairs of photos."""
