"""Measuring a few steps of a training, to plan its length and its memory."""
