"""Many captures, nobody watching: the list, what of each has to run, Snakemake that runs it, and what is told of it."""
