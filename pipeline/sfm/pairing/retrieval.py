"""Visual similarity of photos: their descriptors, aggregated over a codebook that is learnt from the capture.

Descriptors are integers, and so are the codebook and the aggregates here: their products are exact in floating point
whatever the order of summation, so the result is the same for any linear algebra library and number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

from splatpipe.pipeline.sfm.pairing.pairs import Costs

WORDS = 64
ROUNDS = 12  # k-means iterations for the codebook; they need not converge
SAMPLES = 60_000  # descriptors that the codebook is learnt from
PER_PHOTO = 2048  # descriptors of a photo that are aggregated: the largest keypoints
AGGREGATE_NORM = 2048.0  # length of a photo's vector before rounding: products stay below 2**24, exact in float32


def look_alike_costs(descriptors: Sequence[UInt8[np.ndarray, "_ 128"]], seed: int) -> Costs:
    """Return costs from the photos' content: the negative similarity of their aggregated descriptors.

    Args:
        descriptors: Descriptors of each photo, largest keypoints first; iterated twice in sequence.
        seed: For the codebook.
    """
    words = codebook(descriptors, seed)
    vectors = np.empty((len(descriptors), words.size), np.float32)
    for row, photo in zip(vectors, descriptors, strict=True):
        row[:] = aggregate(photo[:PER_PHOTO], words)

    def costs(i: int) -> Float64[np.ndarray, " n"]:
        return np.asarray(-(vectors @ vectors[i]), np.float64)

    return costs


def codebook(descriptors: Sequence[UInt8[np.ndarray, "_ 128"]], seed: int) -> Float32[np.ndarray, "words 128"]:
    """Cluster a sample of the descriptors by k-means, with centres rounded to whole numbers."""
    per_photo = max(1, SAMPLES // max(1, len(descriptors)))
    sample = np.concatenate([_spread(photo[:PER_PHOTO], per_photo) for photo in descriptors]).astype(np.float32)
    if len(sample) == 0:
        return np.zeros((1, 128), np.float32)
    choice = np.random.default_rng(seed).permutation(len(sample))[:WORDS]
    return refine_words(sample, sample[np.sort(choice)], ROUNDS)


def refine_words(
    sample: Float32[np.ndarray, "n 128"], words: Float32[np.ndarray, "words 128"], rounds: int
) -> Float32[np.ndarray, "words 128"]:
    """Move words to the rounded means of the descriptors that are nearest to them: rounds of k-means."""
    words = words.copy()
    whole = sample.astype(np.uint8)
    for _ in range(rounds):
        sums, counts = _sums(whole, assign(sample, words), len(words))
        filled = counts > 0
        words[filled] = np.rint(sums[filled] / counts[filled, None]).astype(np.float32)
    return words


def assign(values: Float32[np.ndarray, "n 128"], words: Float32[np.ndarray, "words 128"]) -> Int64[np.ndarray, " n"]:
    """Return the nearest word of each descriptor, the first in case of ties."""
    distances = values @ words.T  # in place: there are 60,000 rows in a codebook's sample
    distances *= -2.0
    distances += (words * words).sum(axis=1)
    return np.asarray(distances.argmin(axis=1), np.int64)


def aggregate(
    photo: UInt8[np.ndarray, "n 128"], words: Float32[np.ndarray, "words 128"]
) -> Float32[np.ndarray, " length"]:
    """Compute a photo's vector of locally aggregated descriptors (VLAD; Jégou et al., CVPR 2010), rounded.

    Residuals are summed and normalised per word (Arandjelović and Zisserman, CVPR 2013), then as a whole.
    """
    values = photo.astype(np.float32)
    labels = assign(values, words)
    sums, counts = _sums(photo, labels, len(words))
    residuals = (sums - counts[:, None] * words.astype(np.int64)).astype(np.float64)
    lengths = np.sqrt((residuals * residuals).sum(axis=1, keepdims=True))
    residuals /= np.maximum(lengths, 1.0)
    total = max(float(np.sqrt((residuals * residuals).sum())), 1e-12)
    return np.asarray(np.rint(residuals.ravel() * (AGGREGATE_NORM / total)), np.float32)


def _sums(
    values: UInt8[np.ndarray, "n 128"], labels: Int64[np.ndarray, " n"], words: int
) -> tuple[Int64[np.ndarray, "words 128"], Int64[np.ndarray, " words"]]:
    counts = np.bincount(labels, minlength=words).astype(np.int64)
    totals = np.zeros((words, 128), np.int64)
    if len(values):
        filled = np.flatnonzero(counts)
        starts = np.concatenate([[0], np.cumsum(counts[filled])[:-1]])
        totals[filled] = np.add.reduceat(values[np.argsort(labels, kind="stable")], starts, axis=0, dtype=np.int64)
    return totals, counts


def _spread(photo: UInt8[np.ndarray, "n 128"], wanted: int) -> UInt8[np.ndarray, "_ 128"]:
    """Return at most ``wanted`` evenly spaced rows; copied, since a view would keep all of them in memory."""
    return photo[:: max(1, -(-len(photo) // wanted))].copy()
