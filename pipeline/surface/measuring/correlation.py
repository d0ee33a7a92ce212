"""How far errors of a surface model's cells reach: neighbours share them, like depths of neighbouring pixels."""

from __future__ import annotations

import math

SHARED_CELLS = 1.0  # s of the noise correlation exp(-d² / 4 s²) of two cells at distance d, in cells: 3.5 along a line
SHARED_ALONG = 2.0 * math.sqrt(math.pi) * SHARED_CELLS  # sum of that correlation over a line of cells,
SHARED_AROUND = 4.0 * math.pi * SHARED_CELLS**2  # and over an area
