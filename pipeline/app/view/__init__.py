"""``splatpipe view``: a run's results, its training and its control points in the browser, on this machine only."""
