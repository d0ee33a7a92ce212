"""Techniques of training that can be switched on: each a set of hooks."""
