"""A model as it was trained to be rendered, and what is measured on its pictures."""
