"""The stages of the line, one body each. ``line.py`` has their order and their options."""

import splatpipe.pipeline  # noqa: F401  - comes before any stage's pycolmap: see there
