"""A node: jobs of photos over HTTP, as clients of NodeODM send them."""
