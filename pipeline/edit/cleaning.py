"""What of a splat is no part of the scene: floaters, haze, and what no photo vouches for.

Where the photos are known, a Gaussian is suspected of floating if it lies before all that is around it where it is seen
(``depth_islands``). Where their pictures are known, too, what they are worth with it and without decides, together with
how far it hangs before the scene and by what (``floaters``); else whether it hangs together with the scene at all
(``isolation``). Without photos, what goes are the few that hang together apart from all others.

All limits keep real things rather than find every floater: leaves, wires, and what only one photo shows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from splatpipe.pipeline.edit.floaters import LOOKS, LOOSE, Suspects, likely_floaters
from splatpipe.pipeline.edit.isolation import GaussianShapes, far_groups, held
from splatpipe.pipeline.edit.visibility import GaussianVisibility, TrainingPhotos, look_through
from splatpipe.pipeline.splat.gaussians import Gaussians

Flags = Bool[np.ndarray, " n"]
Told = Callable[[int, int], None]

TRANSPARENT = 0.01
"""Opacity that nobody sees, two and a half steps of an 8-bit picture, and that no overlap of a few makes visible."""
FAINT = 0.03  # opacity that is nothing where no photo shows it: seven steps of an 8-bit picture at its very centre
SOLID = 0.1  # opacity that things are made of: haze holds nothing
SEEN_PIXELS = 1.0  # of all photos' pictures, that say anything of a Gaussian
UNSEEN_PIXELS = 0.1
FLOATING = 0.5  # share of what is seen of one that is before all around it
SUSPECTED = 0.3  # the same, where pictures decide: most of it is real, and they keep it
FEW_PHOTOS = 2.0  # that see what hangs loosely: one photo makes up anything before its own picture
OVERSIZED = 0.2  # times the distance to the nearest camera, that a floating Gaussian's standard deviation is large
HAZE = 0.3  # opacity below which a very large Gaussian is no thing, where there are no photos to say so
EXTENT = (0.05, 0.95)  # quantiles of the centres, between which a scene extends
BORDER = 0.8  # share of what is seen of one at the borders of pictures: hardly covered
FEW = 100  # that hang together and are no scene


@dataclass(frozen=True, eq=False)
class CleaningResult:
    """What is to be removed.

    Attributes:
        keep: Which Gaussians stay.
        removed: How many go, by reason; every reason that was looked at.
    """

    keep: Bool[Tensor, " n"]
    removed: dict[str, int]


def clean_scene(gaussians: Gaussians, photos: TrainingPhotos | None = None, told: Told | None = None) -> CleaningResult:
    """Tell which Gaussians are floaters, haze, or beyond the photos.

    Args:
        gaussians: Finite; where they are to be rendered if there are photos, else on the CPU.
        photos: That it was trained on, and no others; None where nobody knows them.
        told: Called with steps done, of how many.

    Raises:
        ValueError: if a Gaussian is not finite.
    """
    if not bool(gaussians.finite().all()):
        raise ValueError("Gaussians that are not finite are to be left out before")
    keep, removed = np.ones(len(gaussians), np.bool_), {}
    for reason, flags in _found(gaussians, photos, told or _untold):
        removed[reason] = int((flags & keep).sum())
        keep &= ~flags
    return CleaningResult(torch.from_numpy(keep), removed)


def removals_in_words(cleaned: CleaningResult) -> str:
    """What was removed and why, for people; that nothing was, where it is so."""
    count, total = sum(cleaned.removed.values()), len(cleaned.keep)
    if not count:
        return "Nothing had to be removed."
    ordered = sorted(cleaned.removed.items(), key=lambda entry: -entry[1])  # sorted keeps the order of equals
    why = ", ".join(f"{number:,} {reason}" for reason, number in ordered if number)
    return f"Removed {count:,} of {total:,} Gaussians: {why}."


def _untold(_done: int, _total: int) -> None:
    """Where nobody listens."""


def _found(gaussians: Gaussians, photos: TrainingPhotos | None, told: Told) -> Iterator[tuple[str, Flags]]:
    """Reasons, and whom they hit."""
    opacity = torch.sigmoid(gaussians.opacity_logits.detach()).numpy(force=True)
    yield "transparent", opacity < TRANSPARENT
    shapes, solid = GaussianShapes.of(gaussians), opacity >= SOLID
    if photos is None or not photos.cameras:
        yield "oversized", _haze(shapes, opacity)
        yield "isolated", far_groups(shapes, LOOSE, solid, FEW)
        return
    looks = len(photos.cameras)
    steps = looks * (1 if photos.picture is None else 1 + LOOKS)
    found = look_through(gaussians, photos, lambda done: told(done, steps))
    seen = found.weight >= SEEN_PIXELS
    floats = seen & (found.floating > FLOATING)
    ground = seen & ~floats & solid
    loose = floats & ~held(shapes, LOOSE, ground, floats & solid)
    large = floats & _oversized(shapes, photos)
    yield "seen by too few photos", loose & (found.photos < FEW_PHOTOS)
    unseen = found.weight < UNSEEN_PIXELS
    yield "seen by none", unseen & ((opacity < FAINT) | ~held(shapes, LOOSE, seen & solid, unseen))
    yield "beyond the photos", _at_edges(found, shapes, seen & solid)
    if photos.picture is None:
        yield "floating", loose & solid & ~large  # which may be all that shows what is far behind
        return
    suspected = seen & (found.floating > SUSPECTED)
    suspects = Suspects(gaussians, shapes, suspected, seen & ~suspected & solid, found)
    floaters = likely_floaters(suspects, photos, lambda done: told(looks + done, steps))
    yield "oversized", floaters & large
    yield "floating", floaters
    told(steps, steps)


def _oversized(shapes: GaussianShapes, photos: TrainingPhotos) -> Flags:
    """Which Gaussians are very large for where they are."""
    nearest = np.full(len(shapes.centres), np.inf)
    for camera in photos.cameras:
        np.minimum(nearest, np.linalg.norm(shapes.centres - camera.centre(), axis=1), out=nearest)
    return np.asarray(shapes.largest > OVERSIZED * nearest)


def _haze(shapes: GaussianShapes, opacity: Float32[np.ndarray, " n"]) -> Flags:
    """Which Gaussians are very large for the scene and hardly there; large solid ones may be its sky."""
    low, high = np.quantile(shapes.centres, EXTENT, axis=0) if len(shapes.centres) else (np.zeros(3), np.zeros(3))
    return np.asarray((shapes.largest > OVERSIZED * float(np.linalg.norm(high - low))) & (opacity < HAZE))


def _at_edges(found: GaussianVisibility, shapes: GaussianShapes, solid: Flags) -> Flags:
    """Which Gaussians only the borders of a photo or two show, and what is better covered does not hold."""
    rough = solid & (found.border > BORDER) & (found.photos < FEW_PHOTOS)
    return np.asarray(rough & ~held(shapes, LOOSE, solid & ~rough, rough))
