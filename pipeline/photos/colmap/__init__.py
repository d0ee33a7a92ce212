"""COLMAP's models, binary and text, from untrusted files."""
