"""Quick low-resolution matching, just enough to find which photos overlap."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.photos.intake.check import CheckedPhoto
from splatpipe.pipeline.photos.intake.detail import (
    Brightness,
    brightness_of,
    detail_at,
    levels_at,
    read_grey,
    signature_of,
)
from splatpipe.pipeline.photos.pixels.images import reduced
from splatpipe.pipeline.sfm.matching.keypoints import DESCRIPTOR_NORM
from splatpipe.pipeline.sfm.pairing.pairs import Pair

LONGEST_PX = 640  # longer side of the matched images: a fifth of a second per photo
MAX_KEYPOINTS = 1000
FEW_KEYPOINTS = 600  # below this (fields, water, dark or hazy photos) fainter keypoints are used too
FAINT = 0.008  # OpenCV's contrast threshold for these; its default is 0.04, COLMAP's is about as low as this
RATIO = 0.85  # best over second-best descriptor angle (ratio test), looser than COLMAP's 0.8: RANSAC follows
MIN_MATCHES = 12  # inliers of a two-view geometry; chance gives a few more than 8
MIN_SHARE = 0.2  # inliers over candidate matches: among many, a smaller share agrees by chance
TOLERANCE_PX = 1.5  # at the low resolution
ROUNDS = 1000  # RANSAC iterations at most
CONFIDENCE = 0.999


@dataclass(frozen=True)
class QuickFeatures:
    """Low-resolution features of a photo.

    Attributes:
        places: (n, 2) keypoints in the stored grid, pixels.
        sizes: Their diameters, likewise.
        angles_deg: Their orientations, from x towards y.
        descriptors: Square-rooted SIFT, unit length.
        detail: Detail at each keypoint, from ``detail_at``.
        levels: Brightness at each keypoint, from ``levels_at``.
        brightness: Brightness of the photo.
        signature: The photo downscaled to a few pixels.
        width: Width of the stored grid, pixels.
        height: Its height.
    """

    places: Float64[np.ndarray, "n 2"]
    sizes: Float64[np.ndarray, " n"]
    angles_deg: Float64[np.ndarray, " n"]
    descriptors: Float32[np.ndarray, "n 128"]
    detail: Float32[np.ndarray, "n directions"]
    levels: Float32[np.ndarray, " n"]
    brightness: Brightness
    signature: Float32[np.ndarray, "side side"]
    width: int
    height: int

    def rooted(self) -> UInt8[np.ndarray, "n 128"]:
        """Return the descriptors in the pipeline's 8-bit format."""
        return np.asarray(np.minimum(np.rint(self.descriptors * DESCRIPTOR_NORM), 255), np.uint8)


@dataclass(frozen=True)
class InlierMatches:
    """Keypoint rows, in the first and the second photo, of matches that agree on a two-view geometry."""

    first: Int64[np.ndarray, " m"]
    second: Int64[np.ndarray, " m"]

    def __len__(self) -> int:
        return len(self.first)


NOTHING = InlierMatches(np.zeros(0, np.int64), np.zeros(0, np.int64))


def quick_features(photo: CheckedPhoto) -> QuickFeatures:
    """Read a photo, extract its largest keypoints at low resolution, and measure detail and brightness around them.

    Raises:
        SplatpipeError: If the file is missing or has changed since it was checked.
    """
    grey = read_grey(photo)
    small = reduced(grey, LONGEST_PX)
    detector = cv2.SIFT_create(enable_precise_upscale=True)
    found = detector.detect(small, None)
    if len(found) < FEW_KEYPOINTS:
        detector = cv2.SIFT_create(contrastThreshold=FAINT, enable_precise_upscale=True)
        found = detector.detect(small, None)
    found = sorted(found, key=lambda keypoint: -keypoint.size)[:MAX_KEYPOINTS]
    values = np.zeros((0, 128), np.float32)
    if found:
        found, values = detector.compute(small, found)
    places = np.array([keypoint.pt for keypoint in found], np.float64).reshape(-1, 2) + 0.5
    full = np.array([photo.width / small.shape[1], photo.height / small.shape[0]])
    seen = places * np.array([grey.shape[1] / small.shape[1], grey.shape[0] / small.shape[0]])
    sums = np.maximum(values.sum(axis=1, keepdims=True), 1e-6)
    return QuickFeatures(
        places=places * full,
        sizes=np.array([keypoint.size for keypoint in found], np.float64) * float(full.mean()),
        angles_deg=np.array([keypoint.angle for keypoint in found], np.float64),
        descriptors=np.sqrt(values / sums).astype(np.float32),
        detail=detail_at(grey, seen),
        levels=levels_at(grey, seen),
        brightness=brightness_of(grey),
        signature=signature_of(grey),
        width=photo.width,
        height=photo.height,
    )


def match_quick_features(
    all_features: Sequence[QuickFeatures], pairs: Iterable[Pair], threads: int
) -> dict[Pair, InlierMatches]:
    """Match pairs of photos; return the inliers of each pair, which may be empty."""
    listed = sorted(set(pairs))
    found = ordered_map(lambda pair: agreement(all_features[pair[0]], all_features[pair[1]]), listed, threads)
    return dict(zip(listed, found, strict=True))


def agreement(first: QuickFeatures, second: QuickFeatures) -> InlierMatches:
    """Return the mutual nearest neighbours of two photos that agree on a fundamental matrix."""
    rows, columns = _mutual(first.descriptors, second.descriptors)
    if len(rows) < MIN_MATCHES:
        return NOTHING
    scale = LONGEST_PX / max(first.width, first.height), LONGEST_PX / max(second.width, second.height)
    here, there = first.places[rows] * scale[0], second.places[columns] * scale[1]
    cv2.setRNGSeed(0)
    _, mask = cv2.findFundamentalMat(here, there, cv2.USAC_FAST, TOLERANCE_PX, CONFIDENCE, ROUNDS)
    if mask is None:
        return NOTHING
    good = np.flatnonzero(mask.ravel())
    if len(good) < max(MIN_MATCHES, MIN_SHARE * len(rows)):
        return NOTHING
    return InlierMatches(rows[good], columns[good])


def _mutual(
    first: Float32[np.ndarray, "n 128"], second: Float32[np.ndarray, "m 128"]
) -> tuple[Int64[np.ndarray, " k"], Int64[np.ndarray, " k"]]:
    """Return the rows of mutual nearest neighbours that pass the ratio test."""
    if min(len(first), len(second)) < 2:
        return NOTHING.first, NOTHING.second
    cosines = first @ second.T
    nearest = cosines.argmax(axis=1)
    rows = np.flatnonzero(cosines.argmax(axis=0)[nearest] == np.arange(len(first)))
    best = cosines[rows, nearest[rows]]
    others = cosines[rows]
    others[np.arange(len(rows)), nearest[rows]] = -1.0
    angles = np.arccos(np.clip(np.stack([best, others.max(axis=1)]), -1.0, 1.0))
    kept = angles[0] < RATIO * angles[1]
    return rows[kept], nearest[rows][kept]
