"""The photos' stated positions: their sources, flights, gaps and swaps."""
