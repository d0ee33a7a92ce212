"""The pipeline's stages, one module each. ``line.py`` defines their order and their options."""

import splatpipe.pipeline  # noqa: F401  - comes before any stage's pycolmap: see there
