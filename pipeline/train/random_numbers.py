"""Counter-based random numbers: a value depends only on (seed, step, stream, index), so a resumed run repeats them.

The generator is SplitMix64's output function over a Weyl sequence (Steele, Lea, Flood: "Fast splittable pseudorandom
number generators", OOPSLA 2014), applied once per key word.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Bits = npt.NDArray[np.uint64]
Doubles = npt.NDArray[np.float64]

_WEYL = np.uint64(0x9E3779B97F4A7C15)  # the golden ratio's fraction, odd: SplitMix64's increment
_MULTIPLY_1 = np.uint64(0xBF58476D1CE4E5B9)
_MULTIPLY_2 = np.uint64(0x94D049BB133111EB)
_WORD = (1 << 64) - 1
_TO_UNIT = 2.0**-53

# Streams: one per use, so that no two uses share numbers.
PHOTO_ORDER = 1
SPLIT_POSITION = 2
BACKGROUND = 3
DROPOUT = 12
ELSEWHERE = 13
WINDOW_ORDER = 14


def _mix(bits: Bits) -> Bits:
    bits = (bits ^ (bits >> np.uint64(30))) * _MULTIPLY_1
    bits = (bits ^ (bits >> np.uint64(27))) * _MULTIPLY_2
    return bits ^ (bits >> np.uint64(31))


def random_bits(seed: int, step: int, stream: int, index: npt.ArrayLike) -> Bits:
    """64 random bits for each index.

    Args:
        seed: The run's seed.
        step: The iteration or epoch, at least 0.
        stream: What the numbers are for, one of this module's constants.
        index: Which numbers, (n,) integers, at least 0.
    """
    key = np.zeros(1, np.uint64)
    for word in (seed, step, stream):
        key = _mix((key ^ np.uint64(word & _WORD)) + _WEYL)
    return _mix(key + _WEYL * (np.asarray(index).astype(np.uint64) + np.uint64(1)))


def uniform(seed: int, step: int, stream: int, index: npt.ArrayLike) -> Doubles:
    """Numbers in (0, 1), both ends excluded; arguments as in ``random_bits``."""
    bits = random_bits(seed, step, stream, index) >> np.uint64(11)
    return np.asarray((bits.astype(np.float64) + 0.5) * _TO_UNIT)


def normal(seed: int, step: int, stream: int, index: npt.ArrayLike) -> Doubles:
    """Standard normal numbers (Box–Muller); arguments as in ``random_bits``."""
    even = 2 * np.asarray(index).astype(np.uint64)
    radius = np.sqrt(-2.0 * np.log(uniform(seed, step, stream, even)))
    return np.asarray(radius * np.cos(2.0 * np.pi * uniform(seed, step, stream, even + np.uint64(1))))


def permutation(seed: int, epoch: int, count: int) -> npt.NDArray[np.int64]:
    """The order of ``count`` photos in an epoch."""
    return np.argsort(random_bits(seed, epoch, PHOTO_ORDER, np.arange(count)), kind="stable").astype(np.int64)
