"""Reading and writing files that somebody else may have made or replaced: bounded, atomic, never through a link."""
