"""Which photos are matched with which: by positions, by footprints on the ground, by retrieval."""
