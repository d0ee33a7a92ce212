"""Counter-based random numbers: a value depends only on (seed, step, stream, index), so a resumed run repeats them.

The generator is SplitMix64's output function over a Weyl sequence (Steele, Lea, Flood: "Fast splittable pseudorandom
number generators", OOPSLA 2014), applied once per key word.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Bits = npt.NDArray[np.uint64]
Doubles = npt.NDArray[np.float64]

_WEYL = 0x9E3779B97F4A7C15  # the golden ratio's fraction, odd: SplitMix64's increment
_MULTIPLY_1 = 0xBF58476D1CE4E5B9
_MULTIPLY_2 = 0x94D049BB133111EB
_WORD = (1 << 64) - 1
_TO_UNIT = 2.0**-53

# Streams: one per use, so that no two uses share numbers.
PHOTO_ORDER = 1
SPLIT_POSITION = 2
BACKGROUND = 3
DROPOUT = 12
ELSEWHERE = 13
WINDOW_ORDER = 14


def _key(*words: int) -> int:
    """The words mixed into one, in Python's integers: as arrays of one they take three times as long."""
    key = 0
    for word in words:
        key = ((key ^ (word & _WORD)) + _WEYL) & _WORD
        key = ((key ^ (key >> 30)) * _MULTIPLY_1) & _WORD
        key = ((key ^ (key >> 27)) * _MULTIPLY_2) & _WORD
        key ^= key >> 31
    return key


def random_bits(seed: int, step: int, stream: int, index: npt.ArrayLike) -> Bits:
    """64 random bits for each index.

    Args:
        seed: The run's seed.
        step: The iteration or epoch, at least 0.
        stream: What the numbers are for, one of this module's constants.
        index: Which numbers, (n,) integers, at least 0.
    """
    bits = np.asarray(index).astype(np.uint64)
    bits += np.uint64(1)
    bits *= np.uint64(_WEYL)
    bits += np.uint64(_key(seed, step, stream))
    shifted = bits >> np.uint64(30)
    for factor, shift in ((_MULTIPLY_1, 27), (_MULTIPLY_2, 31)):
        bits ^= shifted
        bits *= np.uint64(factor)
        np.right_shift(bits, np.uint64(shift), out=shifted)
    bits ^= shifted
    return bits


def uniform(seed: int, step: int, stream: int, index: npt.ArrayLike) -> Doubles:
    """Numbers in (0, 1), both ends excluded; arguments as in ``random_bits``."""
    bits = random_bits(seed, step, stream, index)
    bits >>= np.uint64(11)
    numbers = bits.astype(np.float64)
    numbers += 0.5
    numbers *= _TO_UNIT
    return numbers


def normal(seed: int, step: int, stream: int, index: npt.ArrayLike) -> Doubles:
    """Standard normal numbers (Box–Muller); arguments as in ``random_bits``."""
    even = 2 * np.asarray(index).astype(np.uint64)
    radius = np.sqrt(-2.0 * np.log(uniform(seed, step, stream, even)))
    return np.asarray(radius * np.cos(2.0 * np.pi * uniform(seed, step, stream, even + np.uint64(1))))


def permutation(seed: int, epoch: int, count: int) -> npt.NDArray[np.int64]:
    """The order of ``count`` photos in an epoch."""
    return np.argsort(random_bits(seed, epoch, PHOTO_ORDER, np.arange(count)), kind="stable").astype(np.int64)
