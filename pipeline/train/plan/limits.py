"""What memory and time limits allow in training, as plain arithmetic; cheap to import.

| per Gaussian with degree-3 SH (59 numbers, float32) | bytes |
|---|---|
| parameters | 236 |
| Adam's two moments | 472 |
| statistics of density control | 12 |
| **training state** | **720** |
| a frame that shows it, with its pairs; or, later, the copies made by density control | 576 |

Gradients are never stored. On a CUDA device density control moves one tensor at a time:

| per Gaussian on a CUDA device | bytes |
|---|---|
| parameters and moments | 708 |
| statistics of density control | 12 |
| **training state** | **720** |
| a frame with its pairs in the smallest chunks (see `frame.h`), radii, screen-space gradients | 201 |
| or, later, density control: a copy of SH, positions, scores, an index and its sort | 320 |

| per frozen Gaussian around a block on a CUDA device | bytes |
|---|---|
| parameters | 236 |
| a frame | 201 |
| or, later, density control: a copy | 236 |
"""

from __future__ import annotations

import math

FLOAT_BYTES = 4
SHAPE_NUMBERS = 11  # parameters of a Gaussian besides its colour: position, scales, rotation, opacity
STATE_COPIES = 3  # a parameter and its two moments
STATISTICS_BYTES = 12
PEAK_SHARE = 0.8  # extra over the state: a frame of all, or density control's copies; measured: 0.6 to 0.76, with waste
PIXEL_BYTES = 300  # per pixel of an iteration: three photos read ahead, render and loss, with gradients
FRAME_BYTES = 201  # CUDA frame, per Gaussian
DEVICE_PASSING_BYTES = 320  # transient: the larger of a frame and density control
FIXED_BYTES = 120_000_000  # buffers of the kernels, torch and decoders, whatever the size

LIBRARIES_BYTES = 576_000_000  # base of a training process: interpreter, torch and its dependencies
MACHINE_SHARE = 0.8  # share of the machine's memory for a training without a given limit: leaves room for others

SMALLEST_WINDOW = 60_000  # pixels: below it the 5-pixel margins and the per-Gaussian cost dominate
WINDOW_SHARE = 0.25  # largest share of the memory for pixels and Gaussians that a window may take

FIRST_ITERATIONS = 1500  # iterations wanted within FIRST_SECONDS: with fewer the colours have not settled
FIRST_SECONDS = 30.0
MAX_ITERATIONS = 30_000  # iterations, as published: little is gained beyond
MIN_ITERATIONS = 300  # iterations, however short the time: with fewer the model stays as blurred as it began


def numbers_of(sh_degree: int) -> int:
    """Number of parameters of a Gaussian: its shape, and the SH coefficients of three colours."""
    return SHAPE_NUMBERS + 3 * (sh_degree + 1) ** 2


def bytes_per_gaussian(sh_degree: int) -> int:
    """Peak memory per Gaussian in training on the CPU, bytes."""
    state = STATE_COPIES * FLOAT_BYTES * numbers_of(sh_degree) + STATISTICS_BYTES
    return int(state * (1.0 + PEAK_SHARE))


def device_bytes_per_gaussian(sh_degree: int) -> int:
    """The same on a CUDA device."""
    return STATE_COPIES * FLOAT_BYTES * numbers_of(sh_degree) + STATISTICS_BYTES + DEVICE_PASSING_BYTES


def device_frozen_passing_bytes(sh_degree: int) -> int:
    """Transient memory per frozen Gaussian on a CUDA device, bytes: a frame, or density control's copy."""
    return max(FRAME_BYTES, FLOAT_BYTES * numbers_of(sh_degree))


def window_within(room_bytes: int, window_pixels: int) -> int:
    """Window size, pixels, that fits the memory available for pixels and Gaussians.

    Smaller windows only need more iterations to cover the same area; Gaussians without room cannot be recovered.

    Args:
        room_bytes: Memory available for pixels and Gaussians.
        window_pixels: Window size if memory does not matter; 0: photos are used whole, whatever the memory.
    """
    within = int(WINDOW_SHARE * max(0, room_bytes) / PIXEL_BYTES)
    return min(window_pixels, max(SMALLEST_WINDOW, within))


def worthwhile_iterations(seconds: float) -> int:
    """Minimum iterations worth doing in a training of ``seconds``, from ``MIN_ITERATIONS`` to ``MAX_ITERATIONS``.

    They grow with the square root of the time, so that the work per iteration grows as much; 10 minutes give about
    the 7,000 iterations of the standard preset.
    """
    wanted = FIRST_ITERATIONS * math.sqrt(max(seconds, 1.0) / FIRST_SECONDS)
    return int(min(MAX_ITERATIONS, max(MIN_ITERATIONS, wanted)))
