"""Classifies suspected Gaussians as floaters, from the photos and from their surroundings.

Evidence is combined by logistic regression (D. R. Cox, "The regression analysis of binary sequences", 1958): how much
a Gaussian increases the photos' error, how far in front of everything else it is, how opaque it is, and whether it
is connected to undoubted parts of the scene. The weights were fitted to floaters planted into two captures, and tested
on other planted floaters and on a third capture (`benchmarks/splats/planted_floaters.py`, trials.md).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float32

from splatpipe.pipeline.edit.floaters.error_change import error_change_in_photos
from splatpipe.pipeline.edit.floaters.isolation import NEIGHBOURS, GaussianShapes, TouchRule, held
from splatpipe.pipeline.edit.floaters.visibility import GaussianVisibility, TrainingPhotos
from splatpipe.pipeline.splat.model.gaussians import Gaussians

Flags = Bool[np.ndarray, " n"]
Figures = Float32[np.ndarray, " n"]

LOOSE = TouchRule(sigmas=2.0, size_ratio=4.0)
"""Gaussians not connected to the scene even by this rule are loose."""
LIGHTLY_HELD = TouchRule(sigmas=2.0, size_ratio=1.0, needed=3)
"""Gaussians not connected by this stricter rule are held only lightly, like leaves, edges or near-surface floaters."""
LIMITS = ((0.02, 0.05), (0.008, 0.015), (0.003, 0.005))
"""Limits per pass on the change of a pixel's squared error (0..3) per unit of a Gaussian's weight. A Gaussian that
worsens the photos by more than the first is left out of later passes, since it makes what is behind it look bad; one
that improves them by more than the second is cleared and rendered at full opacity."""
PASSES = len(LIMITS) + 1  # passes over all photos: likely floaters get one more, by themselves
MIN_GAP = 0.003  # share of the depth: the accuracy of the gap
PIXEL_NOISE = 1.0 / 30.0  # noise of one pixel's summed squared error (colours 0 to 1); over n pixels it grows with √n
EVIDENCE = {
    "worse on the whole": 1.45,
    "worse in some": 1.4,
    "gap": 0.55,
    "floating": 3.6,
    "loose": 3.7,
    "lightly held": 1.3,
    "opacity": -2.4,
}
"""Weight of each feature of ``evidence`` in the log-odds that a Gaussian is a floater."""
PRIOR = -6.3
NEEDLESS = (1.0, 0.5, 0.5)
"""Least use to the photos, over their noise, largest share in front of everything and least opacity of a Gaussian that
is kept although it hangs where a camera was."""


@dataclass(frozen=True, eq=False)
class Suspects:
    """The suspected floaters, and what is known of all Gaussians.

    Attributes:
        gaussians: All Gaussians, finite, on the device that renders them.
        shapes: Their shapes.
        suspected: Which are suspected.
        ground: Which are undoubted and solid enough to hold others.
        sightings: Their visibility in the photos.
    """

    gaussians: Gaussians
    shapes: GaussianShapes
    suspected: Flags
    ground: Flags
    sightings: GaussianVisibility


@dataclass(frozen=True, eq=False)
class Verdicts:
    """The effect of each suspect on the photos, in its worst pass; 0 for Gaussians that are not suspected.

    Attributes:
        worse: Total increase of squared errors with it, over the photos in which they increase.
        better: Total decrease with it, over the other photos.
    """

    worse: Figures
    better: Figures


def likely_floaters(suspects: Suspects, photos: TrainingPhotos, on_progress: Callable[[int], None]) -> Flags:
    """Which of the suspects are more likely floaters than not.

    Args:
        suspects: The suspects and what is known of them.
        photos: The training photos, with images.
        on_progress: Called with the number of images processed, at most ``PASSES`` times that of photos compared.
    """
    if suspects.ground.sum() <= NEIGHBOURS:
        return np.zeros(len(suspects.ground), np.bool_)  # not enough of a scene for anything to float in front of
    verdicts = verdicts_of(suspects, photos, on_progress)
    figures = evidence(suspects, verdicts)
    odds = PRIOR + sum(EVIDENCE[name] * figure for name, figure in figures.items())
    veils = needless(suspects, verdicts, figures)
    likely = np.asarray(suspects.suspected & ((odds > 0.0) | veils))
    if not likely.any():
        return likely
    done_before = len(LIMITS) * len(photos.compared_photos)
    worth = error_change_in_photos(suspects.gaussians, likely, photos, partial(_after, on_progress, done_before))
    use = np.where(veils, NEEDLESS[0] * _noise(suspects), LIMITS[-1][1] * _pixels(suspects))
    missed = worth.better - worth.worse > use
    return np.asarray(likely & ~(missed & (figures["loose"] == 0.0)))  # a loose one may hide other floaters


def needless(suspects: Suspects, verdicts: Verdicts, figures: dict[str, Figures]) -> Flags:
    """Which of the suspects hang faintly where a camera was and help no photo.

    Training leaves such Gaussians where no photo looks from nearby; from afar they hardly differ from what is behind
    them, but a camera between two others meets them as veils.
    """
    use, floating, opacity = NEEDLESS
    of_none = verdicts.better - verdicts.worse < use * _noise(suspects)
    hanging = (figures["floating"] > floating) & (figures["opacity"] < opacity)
    return np.asarray(suspects.suspected & suspects.sightings.beside & hanging & of_none)


def _pixels(suspects: Suspects) -> Figures:
    """Effective number of pixels that show each Gaussian in the photos compared, at least 1."""
    return np.asarray(np.maximum(suspects.sightings.compared, np.float32(1.0)))


def _noise(suspects: Suspects) -> Figures:
    """Noise of the summed squared error of the pixels that show each Gaussian."""
    return np.asarray(PIXEL_NOISE * np.sqrt(_pixels(suspects)))


def evidence(suspects: Suspects, verdicts: Verdicts) -> dict[str, Figures]:
    """The features of the logistic regression by name, as in ``EVIDENCE``."""
    suspected, seen = suspects.suspected, suspects.sightings
    noise = _noise(suspects)
    loose, light = (
        suspected & ~held(suspects.shapes, touch, suspects.ground, suspected) for touch in (LOOSE, LIGHTLY_HELD)
    )
    return {
        "worse on the whole": np.log1p(np.maximum(verdicts.worse - verdicts.better, 0.0) / noise),
        "worse in some": np.log1p(verdicts.worse / noise),
        "gap": np.log(np.maximum(seen.gap, np.float32(MIN_GAP))),
        "floating": seen.floating,
        "loose": loose.astype(np.float32),
        "lightly held": light.astype(np.float32),
        "opacity": torch.sigmoid(suspects.gaussians.opacity_logits.detach()).numpy(force=True),
    }


def verdicts_of(suspects: Suspects, photos: TrainingPhotos, on_progress: Callable[[int], None]) -> Verdicts:
    """Measure the suspects' effect on the photos in several passes, excluding the worst suspects after each."""
    gaussians, pixels = suspects.gaussians, _pixels(suspects)
    n = len(gaussians)
    worse, better, least = np.zeros(n, np.float32), np.zeros(n, np.float32), np.full(n, np.inf, np.float32)
    remaining, asked = np.ones(n, np.bool_), suspects.suspected.copy()
    for number, (bad, good) in enumerate(LIMITS):
        if not asked.any():
            break
        rows = np.flatnonzero(remaining)
        model = gaussians if len(rows) == n else gaussians.select(torch.from_numpy(rows).to(gaussians.means.device))
        done_before = number * len(photos.compared_photos)
        worth = error_change_in_photos(model, asked[rows], photos, partial(_after, on_progress, done_before))
        of_pixel = np.full(n, np.inf, np.float32)
        of_pixel[rows] = (worth.better - worth.worse) / pixels[rows]
        lower = asked[rows] & (of_pixel[rows] < least[rows])
        least[rows[lower]] = of_pixel[rows[lower]]
        worse[rows[lower]], better[rows[lower]] = worth.worse[lower], worth.better[lower]
        remaining &= ~(asked & (of_pixel < -bad))
        asked &= remaining & (of_pixel <= good)
    return Verdicts(worse, better)


def _after(on_progress: Callable[[int], None], before: int, done: int) -> None:
    on_progress(before + done)
