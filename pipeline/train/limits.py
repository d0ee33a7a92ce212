"""What limits of memory and time allow a training, as plain arithmetic. Light to import.

| of a Gaussian with SH of degree 3 (59 numbers, float32) | bytes |
|---|---|
| parameters | 236 |
| Adam's two moments | 472 |
| statistics of density control | 12 |
| **state of training** | **720** |
| a frame that shows it, with its pairs; or, later, what density control copies | 576 |

Gradients are never stored. On a CUDA device density control moves one tensor at a time:

| of the same Gaussian on a CUDA device | bytes |
|---|---|
| parameters and moments | 708 |
| statistics of density control | 12 |
| **state of training** | **720** |
| a frame with its pairs in the smallest chunks (see `frame.h`), radii, gradients on the screen | 201 |
| or, later, density control: a copy of the harmonics, places, scores, an index and its sort | 320 |
"""

from __future__ import annotations

import math

FLOAT_BYTES = 4
SHAPE_NUMBERS = 11  # of a Gaussian besides its colour: position, scales, rotation, opacity
STATE_COPIES = 3  # a parameter has two moments
STATISTICS_BYTES = 12
PEAK_SHARE = 0.8  # of the state: a frame of all, or what density control copies; measured: 0.6 to 0.76, with waste
PIXEL_BYTES = 300  # of what an iteration looks at: read thrice ahead, rendered, compared, each with its gradient
DEVICE_PASSING_BYTES = 320  # the larger of what a frame and density control take
FIXED_BYTES = 120_000_000  # buffers of the kernels, of torch and of decoders, whatever the size

LIBRARIES_BYTES = 576_000_000  # of a training's process, whatever it trains: interpreter, torch, what comes with it
MACHINE_SHARE = 0.8  # of a machine's memory, that a training may take where nobody gave a limit: others want some

SMALLEST_WINDOW = 60_000  # pixels: below it margins, 5 pixels a side, and the Gaussians' own cost are what is paid for
WINDOW_SHARE = 0.25  # of the memory for pixels and Gaussians, that a window takes at most

FIRST_ITERATIONS = 1500  # a training of FIRST_SECONDS shall have as many: below it the colours have not settled
FIRST_SECONDS = 30.0
LONGEST = 30_000  # iterations, as published: beyond them little is learnt
FEWEST = 300  # iterations, however short the time: fewer do not leave the initial blur


def numbers_of(sh_degree: int) -> int:
    """Of a Gaussian: its shape, and three colours of as many coefficients as its harmonics have."""
    return SHAPE_NUMBERS + 3 * (sh_degree + 1) ** 2


def bytes_per_gaussian(sh_degree: int) -> int:
    """Most that a Gaussian takes at any time of a training on the CPU."""
    state = STATE_COPIES * FLOAT_BYTES * numbers_of(sh_degree) + STATISTICS_BYTES
    return int(state * (1.0 + PEAK_SHARE))


def device_bytes_per_gaussian(sh_degree: int) -> int:
    """The same on a CUDA device."""
    return STATE_COPIES * FLOAT_BYTES * numbers_of(sh_degree) + STATISTICS_BYTES + DEVICE_PASSING_BYTES


def window_within(room_bytes: int, window_pixels: int) -> int:
    """Pixels of the windows that a training with so much memory for pixels and Gaussians looks through.

    Smaller ones show as much in more iterations; Gaussians that have no room are never there.

    Args:
        room_bytes: For them.
        window_pixels: Of a window where memory is no matter; 0: photos are looked at whole, whatever the room.
    """
    within = int(WINDOW_SHARE * max(0, room_bytes) / PIXEL_BYTES)
    return min(window_pixels, max(SMALLEST_WINDOW, within))


def worthwhile_iterations(seconds: float) -> int:
    """Iterations that a training of so many seconds shall have at least, from ``FEWEST`` to ``LONGEST``.

    They grow with the root of the time, so that what they work on grows as much; with it 10 minutes give about the
    7,000 of the standard preset.
    """
    wanted = FIRST_ITERATIONS * math.sqrt(max(seconds, 1.0) / FIRST_SECONDS)
    return int(min(LONGEST, max(FEWEST, wanted)))
