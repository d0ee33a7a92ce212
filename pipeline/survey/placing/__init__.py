"""A model in the world by its photos' positions: fits, their noise and their uncertainty."""
