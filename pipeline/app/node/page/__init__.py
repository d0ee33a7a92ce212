"""The node's own page: drop photos, follow runs, open results."""
