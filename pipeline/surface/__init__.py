"""What a surveyor takes away: surface model and orthophoto, tile by tile."""
