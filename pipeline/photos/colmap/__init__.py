"""COLMAP's binary models, from untrusted bytes."""
