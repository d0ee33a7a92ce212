"""Takes a far origin off a file's coordinates, as they are read and before they become 32-bit numbers.

Programs for surveys write splats in projected, earth-centred or geographic coordinates, often as float64: at a northing
of 5,000,000 m, float32 has steps of half a metre. What is taken off is kept in ``SceneFacts.offset``.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.splat.containers.bounded import usable
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.position_cost import sizes_of, two_digits
from splatpipe.pipeline.splat.model.scene import MAX_OFFSET, Scene, SceneFacts

STEPS_PER_SIZE = 16.0  # float32 steps in a Gaussian's size: finer ones are not seen
STEPS_ACROSS = 4096.0  # float32 steps in a splat's extent, if its Gaussians' sizes are in another unit
ROUNDED_STEPS = 0.5  # Gaussians' sizes in a step that has visibly displaced them
EXTENT = (0.05, 0.95)  # quantiles that bound a splat's main extent
SAMPLE = 200_000  # Gaussians that this is estimated from
MIXED_UNITS = 2.0  # extents of the splat along two axes in its median Gaussian: its scales are in another unit
# share of Gaussians that float32 displaces by more than their largest size: parts of the splat are lost
MIN_TORN_SHARE = 0.05
FEW = 10  # Gaussians that may well be larger than the distances between them
MAX_LOG = 700.0  # largest natural logarithm whose exponential float64 holds


def scene_near_origin(path: Path, gaussians: Gaussians, facts: SceneFacts) -> Scene:
    """The scene of a file: in float32, about an origin near it if float32 would be too coarse where it lies.

    A splat without axes of its own (y down, as viewers assume) is taken as z up if an origin is taken off: such
    coordinates are a survey's.

    Args:
        path: For messages.
        gaussians: As stored, with positions of float32 or float64; changed in place.
        facts: Of the file's record, or the format's defaults.

    Raises:
        SplatpipeError: if float32 is too coarse for positions that a record places on the earth.
    """
    stored_as_float32 = gaussians.means.dtype == torch.float32
    lying = _Placement.of(gaussians)
    notes = () if lying is None else lying.notes(path)
    if stored_as_float32 and lying is not None and lying.too_far:
        notes += lying.rounding(path)
    if lying is None or not lying.too_far:
        _to_float32(path, gaussians)
        return Scene(gaussians, facts, notes)
    if facts.place is not None:
        if stored_as_float32:  # no finer than it was
            return Scene(gaussians, facts, notes)
        raise SplatpipeError(
            f"{path}: it lies {float(np.abs(lying.middle).max()):,.0f} m from the origin that its own record places on "
            "the earth: another program has changed one of the two.",
            hint="Remove the record (a PLY's header line 'comment splatpipe …'), and its coordinates are kept.",
        )
    origin = lying.origin()
    for piece in gaussians.pieces():
        piece.means -= torch.tensor(origin, dtype=torch.float64)
    _to_float32(path, gaussians)
    x, y, z = (before + taken for before, taken in zip(facts.offset, origin, strict=True))
    axes = "z up" if facts.axes == "y down" else facts.axes
    return Scene(gaussians, replace(facts, axes=axes, offset=(x, y, z)), notes)


class _Placement:
    """Where a splat lies in its coordinates, and how large it and its Gaussians are."""

    def __init__(self, means: Float64[np.ndarray, "n 3"], log_scales: Float64[np.ndarray, "n 3"]) -> None:
        low, self.middle, high = np.quantile(means, (EXTENT[0], 0.5, EXTENT[1]), axis=0)
        self.extents = high - low
        sizes = np.sort(log_scales, axis=1)
        self.count = len(means)
        self.size = math.exp(min(float(np.median(sizes[:, 1])), MAX_LOG))
        self.largest = math.exp(min(float(np.median(sizes[:, 2])), MAX_LOG))
        self.across = float(np.sort(self.extents)[1])
        self.mixed = self.count >= FEW and self.size > MIXED_UNITS * self.across
        self.step = float(np.spacing(np.float32(np.abs(self.middle).max())))

    @staticmethod
    def of(gaussians: Gaussians) -> _Placement | None:
        """Of an even sample; None if no Gaussian has usable values."""
        every = max(1, -(-len(gaussians) // SAMPLE))
        sample = gaussians.select(torch.arange(0, len(gaussians), every))
        sample = sample.select(usable(sample))
        return _Placement(sample.means.double().numpy(), sample.log_scales.double().numpy()) if len(sample) else None

    @property
    def too_far(self) -> bool:
        """Whether float32 is too coarse, and an origin in the splat's middle would help."""
        coarse = self.step * STEPS_PER_SIZE > self.size or (self.mixed and self.step * STEPS_ACROSS > self.across)
        distance = float(np.abs(self.middle).max())
        return coarse and float(np.linalg.norm(self.extents)) + self.largest < distance < MAX_OFFSET

    def origin(self) -> tuple[float, float, float]:
        """The middle, in digits as few as the splat's extent along each axis allows."""
        reaches = np.maximum(self.extents + (0.0 if self.mixed else self.largest), self.step)
        digits = [-math.floor(math.log10(reach)) for reach in reaches.tolist()]
        x, y, z = (round(number, count) for number, count in zip(self.middle.tolist(), digits, strict=True))
        return x, y, z

    def rounding(self, path: Path) -> tuple[str, ...]:
        """What has been lost before, if positions were float32."""
        if self.step <= ROUNDED_STEPS * self.size:
            return ()
        return (
            f"{path}: its positions had been rounded to {two_digits(self.step)} before, and half of its Gaussians are "
            f"smaller than {two_digits(self.size)}: export it again with 64-bit coordinates, or about a near origin.",
        )

    def notes(self, path: Path) -> tuple[str, ...]:
        """What is odd about it."""
        if not self.mixed:
            return ()
        return (
            f"{path}: half of its Gaussians are larger than {two_digits(self.size)}, but along two axes it extends "
            f"only {two_digits(self.across)}: its coordinates and scales appear to be in different units, such as "
            "degrees and metres. Export it in projected coordinates.",
        )


def _to_float32(path: Path, gaussians: Gaussians) -> None:
    """Round the positions to float32.

    Raises:
        SplatpipeError: if a part of the splat would fall apart.
    """
    if gaussians.means.dtype == torch.float32:
        return
    lost, count = 0, len(gaussians)
    for piece in gaussians.pieces():
        moved = (piece.means - piece.means.float()).abs().amax(1).numpy()
        lost += int((moved > sizes_of(piece.log_scales)[:, 1]).sum())
    if lost > MIN_TORN_SHARE * count:
        raise SplatpipeError(
            f"{path}: it extends so far that 32-bit coordinates would displace {lost:,} of {count:,} Gaussians by more "
            "than their size.",
            hint="Export its parts separately, each with an origin of its own.",
        )
    gaussians.means = gaussians.means.float()
