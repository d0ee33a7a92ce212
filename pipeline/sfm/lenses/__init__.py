"""The lens of each camera: known calibrations, focal lengths, lens models by trial and by adjustment."""
