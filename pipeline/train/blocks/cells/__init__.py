"""The cells of a site: how it is divided, and what of the scene each block sees."""
