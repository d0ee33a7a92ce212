"""How likely what hangs in the air is a floater, by the photos and by where it is.

Evidence is added up as a logistic regression does (D. R. Cox, "The regression analysis of binary sequences", 1958): how
much worse photos are with a Gaussian than without, how far before everything else it hangs, how opaque it is, and
whether it hangs together with what nobody doubts. The weights were fitted to floaters planted into two captures, and
tried on others and on a third capture (`benchmarks/planted_floaters.py`, trials.md).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float32

from splatpipe.pipeline.edit.error_change import error_change_in_photos
from splatpipe.pipeline.edit.isolation import NEIGHBOURS, GaussianShapes, TouchRule, held
from splatpipe.pipeline.edit.visibility import GaussianVisibility, TrainingPhotos
from splatpipe.pipeline.splat.gaussians import Gaussians

Flags = Bool[np.ndarray, " n"]
Figures = Float32[np.ndarray, " n"]

LOOSE = TouchRule(sigmas=2.0, size_ratio=4.0)
"""What does not hang together even like this with the scene hangs apart."""
LIGHTLY_HELD = TouchRule(sigmas=2.0, size_ratio=1.0, needed=3)
"""What does not hang together like this does at most as leaves and edges do, and floaters near a surface."""
LIMITS = ((0.02, 0.05), (0.008, 0.015), (0.003, 0.005))
"""Squared error of a pixel (0..3), by a Gaussian's mean weight, look after look: what makes photos worse by more than
the first is left out of the next look, since it makes what is behind look bad; what makes them better by more than the
second is cleared, and shown in full."""
LOOKS = len(LIMITS) + 1  # at all photos: those that are likely floaters are looked at once more, by themselves
LEAST_GAP = 0.003  # share of the depth: how far before the rest one is, is not known better
NOISE = 1.0 / 30.0  # of the sum of squared errors of one pixel; it grows with the root of their number
EVIDENCE = {
    "worse on the whole": 1.45,
    "worse in some": 1.4,
    "gap": 0.55,
    "floating": 3.6,
    "loose": 3.7,
    "lightly held": 1.3,
    "opacity": -2.4,
}
"""What each of the figures of ``evidence`` adds to the logarithm of the odds that one is a floater."""
PRIOR = -6.3


@dataclass(frozen=True, eq=False)
class Suspects:
    """Who may float, and what is known of all.

    Attributes:
        gaussians: All, finite; where they are rendered.
        shapes: Theirs.
        suspected: Who is asked about.
        ground: Whom nobody doubts, and who is solid enough to hold others.
        sightings: What photos see.
    """

    gaussians: Gaussians
    shapes: GaussianShapes
    suspected: Flags
    ground: Flags
    sightings: GaussianVisibility


@dataclass(frozen=True, eq=False)
class Verdicts:
    """What photos say of each suspect, in the look in which it was worst; 0 of those that nobody suspects.

    Attributes:
        worse: By how much the photos' squared errors are larger with it, where they are.
        better: By how much they are smaller, where they are.
    """

    worse: Figures
    better: Figures


def likely_floaters(suspects: Suspects, photos: TrainingPhotos, told: Callable[[int], None]) -> Flags:
    """Which of the suspects are floaters rather than not.

    Args:
        suspects: And what is known of them.
        photos: With pictures.
        told: Called with the number of pictures that were looked at, ``LOOKS`` times all at most.
    """
    if suspects.ground.sum() <= NEIGHBOURS:
        return np.zeros(len(suspects.ground), np.bool_)  # that is no scene before which anything hangs
    figures = evidence(suspects, verdicts_of(suspects, photos, told))
    odds = PRIOR + sum(EVIDENCE[name] * figure for name, figure in figures.items())
    likely = np.asarray(suspects.suspected & (odds > 0.0))
    if not likely.any():
        return likely
    looks = len(LIMITS) * len(photos.cameras)
    worth = error_change_in_photos(suspects.gaussians, likely, photos, partial(_after, told, looks))
    missed = (worth.better - worth.worse) / _pixels(suspects) > LIMITS[-1][1]
    return np.asarray(likely & ~(missed & (figures["loose"] == 0.0)))  # what hangs apart may hide more of its own kind


def _pixels(suspects: Suspects) -> Figures:
    """That show each."""
    return np.asarray(np.maximum(suspects.sightings.weight, np.float32(1.0)))


def evidence(suspects: Suspects, verdicts: Verdicts) -> dict[str, Figures]:
    """The figures that are weighed."""
    suspected, seen = suspects.suspected, suspects.sightings
    noise = NOISE * np.sqrt(_pixels(suspects))
    loose, light = (
        suspected & ~held(suspects.shapes, touch, suspects.ground, suspected) for touch in (LOOSE, LIGHTLY_HELD)
    )
    return {
        "worse on the whole": np.log1p(np.maximum(verdicts.worse - verdicts.better, 0.0) / noise),
        "worse in some": np.log1p(verdicts.worse / noise),
        "gap": np.log(np.maximum(seen.gap, np.float32(LEAST_GAP))),
        "floating": seen.floating,
        "loose": loose.astype(np.float32),
        "lightly held": light.astype(np.float32),
        "opacity": torch.sigmoid(suspects.gaussians.opacity_logits.detach()).numpy(force=True),
    }


def verdicts_of(suspects: Suspects, photos: TrainingPhotos, told: Callable[[int], None]) -> Verdicts:
    """Ask the photos, the worst suspects first."""
    gaussians, pixels = suspects.gaussians, _pixels(suspects)
    n = len(gaussians)
    worse, better, least = np.zeros(n, np.float32), np.zeros(n, np.float32), np.full(n, np.inf, np.float32)
    shown, asked = np.ones(n, np.bool_), suspects.suspected.copy()
    for number, (bad, good) in enumerate(LIMITS):
        if not asked.any():
            break
        rows = np.flatnonzero(shown)
        model = gaussians if len(rows) == n else gaussians.select(torch.from_numpy(rows).to(gaussians.means.device))
        looks = number * len(photos.cameras)
        worth = error_change_in_photos(model, asked[rows], photos, partial(_after, told, looks))
        of_pixel = np.full(n, np.inf, np.float32)
        of_pixel[rows] = (worth.better - worth.worse) / pixels[rows]
        lower = asked[rows] & (of_pixel[rows] < least[rows])
        least[rows[lower]] = of_pixel[rows[lower]]
        worse[rows[lower]], better[rows[lower]] = worth.worse[lower], worth.better[lower]
        shown &= ~(asked & (of_pixel < -bad))
        asked &= shown & (of_pixel <= good)
    return Verdicts(worse, better)


def _after(told: Callable[[int], None], before: int, done: int) -> None:
    told(before + done)
