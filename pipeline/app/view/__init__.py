"""``splatpipe view``: shows a run's results and training, and marks control points, in a local browser."""
