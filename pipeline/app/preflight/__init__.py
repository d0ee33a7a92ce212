"""The preflight: finds problems of a capture in the field, before leaving the site."""
