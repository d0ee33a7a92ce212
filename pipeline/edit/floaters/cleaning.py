"""Finds what in a splat is not part of the scene: floaters, haze, and what no photo supports.

If the cameras are known, a Gaussian is suspected of floating if it lies in front of everything around it in the photos
(``depth_islands``). If the images are known too, the change of their error with and without it decides, together with
how far in front of the scene it floats and how it is held (``floaters``); else whether it is connected to the scene at
all (``isolation``). Without photos, small groups apart from all others are removed.

All limits are set to keep real objects rather than to find every floater: leaves, wires, what only one photo shows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from splatpipe.pipeline.edit.floaters.floaters import LOOSE, PASSES, Suspects, likely_floaters
from splatpipe.pipeline.edit.floaters.isolation import GaussianShapes, far_groups, held
from splatpipe.pipeline.edit.floaters.visibility import GaussianVisibility, TrainingPhotos, measure_visibility
from splatpipe.pipeline.splat.model.gaussians import Gaussians

Flags = Bool[np.ndarray, " n"]
Progress = Callable[[int, int], None]

TRANSPARENT = 0.01
"""Invisible opacity: two and a half steps of an 8-bit image, and a few overlapping ones stay invisible."""
FAINT_OPACITY = 0.03  # opacity negligible where no photo shows it: seven steps of an 8-bit image at its very centre
SOLID_OPACITY = 0.1  # least opacity of solid objects: haze holds nothing
SEEN_PIXELS = 1.0  # visible pixels, over all photos, that make a Gaussian count as seen
UNSEEN_PIXELS = 0.1
FLOATING_SHARE = 0.5  # share of a Gaussian's visible area that lies in front of everything around it
SUSPECTED_SHARE = 0.3  # visible share in front of everything that gets tested on images: most of these are real
MIN_PHOTOS = 2.0  # photos that must see a loose Gaussian: training can put anything in front of a single photo
OVERSIZED_RATIO = 0.2  # large standard deviation of a floating Gaussian over its distance to the nearest camera
HAZE_OPACITY = 0.3  # opacity below which a very large Gaussian is not an object, if there are no photos to tell
EXTENT_QUANTILES = (0.05, 0.95)  # quantiles of the centres that bound the scene's extent
BORDER_SHARE = 0.8  # share of a Gaussian's visibility at image borders above which it is hardly covered
FEW = 100  # Gaussians in a connected group too small to be the scene


@dataclass(frozen=True, eq=False)
class CleaningResult:
    """The result of cleaning.

    Attributes:
        keep: Which Gaussians to keep.
        removed: Number to remove by reason, for every reason checked.
    """

    keep: Bool[Tensor, " n"]
    removed: dict[str, int]


def clean_scene(
    gaussians: Gaussians, photos: TrainingPhotos | None = None, on_progress: Progress | None = None
) -> CleaningResult:
    """Find which Gaussians are floaters, haze, or beyond the photos.

    Args:
        gaussians: Finite Gaussians, on the device that renders them if there are photos, else on the CPU.
        photos: Exactly the photos it was trained on; None if unknown.
        on_progress: Called with the steps done and their total.

    Raises:
        ValueError: if a Gaussian is not finite.
    """
    if not bool(gaussians.finite().all()):
        raise ValueError("Gaussians that are not finite are to be left out before")
    keep, removed = np.ones(len(gaussians), np.bool_), {}
    for reason, flags in _found(gaussians, photos, on_progress or _ignore_progress):
        removed[reason] = int((flags & keep).sum())
        keep &= ~flags
    return CleaningResult(torch.from_numpy(keep), removed)


def removals_in_words(cleaned: CleaningResult) -> str:
    """A sentence for people on what was removed and why."""
    count, total = sum(cleaned.removed.values()), len(cleaned.keep)
    if not count:
        return "Nothing had to be removed."
    ordered = sorted(cleaned.removed.items(), key=lambda entry: -entry[1])  # sorted keeps the order of equals
    why = ", ".join(f"{number:,} {reason}" for reason, number in ordered if number)
    return f"Removed {count:,} of {total:,} Gaussians: {why}."


def _ignore_progress(_done: int, _total: int) -> None:
    """Ignore progress."""


def _found(gaussians: Gaussians, photos: TrainingPhotos | None, on_progress: Progress) -> Iterator[tuple[str, Flags]]:
    """Yield the reasons for removal and the Gaussians each applies to."""
    opacity = torch.sigmoid(gaussians.opacity_logits.detach()).numpy(force=True)
    yield "transparent", opacity < TRANSPARENT
    shapes, solid = GaussianShapes.of(gaussians), opacity >= SOLID_OPACITY
    if photos is None or not photos.cameras:
        yield "oversized", _haze(shapes, opacity)
        yield "isolated", far_groups(shapes, LOOSE, solid, FEW)
        return
    photo_count = len(photos.cameras)
    steps = photo_count + (0 if photos.picture is None else PASSES * len(photos.compared_photos))
    found = measure_visibility(gaussians, photos, lambda done: on_progress(done, steps))
    seen = found.weight >= SEEN_PIXELS
    floats = seen & (found.floating > FLOATING_SHARE)
    ground = seen & ~floats & solid
    loose = floats & ~held(shapes, LOOSE, ground, floats & solid)
    large = floats & _oversized(shapes, photos)
    yield "seen by too few photos", loose & (found.photos < MIN_PHOTOS)
    unseen = found.weight < UNSEEN_PIXELS
    yield "seen by none", unseen & ((opacity < FAINT_OPACITY) | ~held(shapes, LOOSE, seen & solid, unseen))
    yield "beyond the photos", _at_edges(found, shapes, seen & solid)
    if photos.picture is None:
        yield "floating", loose & solid & ~large  # large ones may be all that represents the far background
        return
    suspected = seen & (found.floating > SUSPECTED_SHARE) & (found.compared >= SEEN_PIXELS)
    suspects = Suspects(gaussians, shapes, suspected, seen & ~suspected & solid, found)
    floaters = likely_floaters(suspects, photos, lambda done: on_progress(photo_count + done, steps))
    yield "oversized", floaters & large
    yield "floating", floaters
    on_progress(steps, steps)


def _oversized(shapes: GaussianShapes, photos: TrainingPhotos) -> Flags:
    """Which Gaussians are very large for their distance to the nearest camera."""
    nearest = np.full(len(shapes.centres), np.inf)
    for camera in photos.cameras:
        np.minimum(nearest, np.linalg.norm(shapes.centres - camera.centre(), axis=1), out=nearest)
    return np.asarray(shapes.largest > OVERSIZED_RATIO * nearest)


def _haze(shapes: GaussianShapes, opacity: Float32[np.ndarray, " n"]) -> Flags:
    """Which Gaussians are very large for the scene and faint; large solid ones may be its sky."""
    low, high = (
        np.quantile(shapes.centres, EXTENT_QUANTILES, axis=0) if len(shapes.centres) else (np.zeros(3), np.zeros(3))
    )
    return np.asarray((shapes.largest > OVERSIZED_RATIO * float(np.linalg.norm(high - low))) & (opacity < HAZE_OPACITY))


def _at_edges(found: GaussianVisibility, shapes: GaussianShapes, solid: Flags) -> Flags:
    """Which Gaussians only the borders of one or two photos show and are not held by better covered ones."""
    rough = solid & (found.border > BORDER_SHARE) & (found.photos < MIN_PHOTOS)
    return np.asarray(rough & ~held(shapes, LOOSE, solid & ~rough, rough))
