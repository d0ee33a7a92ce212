"""A model in the world by surveyed points: fits, blunders, residuals and accuracy."""
