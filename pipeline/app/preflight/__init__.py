"""The preflight: what is wrong with a capture, told in the field, before leaving."""
