"""``splatpipe node``: takes captures over HTTP as NodeODM does, runs them one after the other, and returns results."""
