"""When a frame counts as equal to the definition: tolerances by quantity, and violations. Without torch."""

from __future__ import annotations

import numpy as np
from frames import RenderCase, RenderOutcome

# Largest differences of images, float32 against float64.
PICTURES = {
    "colour": 5e-6,  # sums of some hundred rounded terms of size 1
    "alpha": 5e-6,
    "depth_sum": 5e-5,  # sums of some hundred rounded depths up to ten
    "depth_square_sum": 3e-4,  # sums of some hundred rounded squares of depths up to ten
    "median_depth": 5e-5,  # one depth
}
RADII = 2e-4
"""Relative and in pixels: the root of an eigenvalue of the covariance."""
GRADIENTS = 2e-5
"""L2 over all Gaussians, relative: sums over a hundred pixels, through divisions by 1 - alpha ≥ 0.01."""
NO_GRADIENT = 1e-6
"""Smaller gradients are rounding."""
FLIPPED = 4e-3
"""Share of the pixels where rounding may decide whether a Gaussian at a threshold (1/255, 1e-4, a half) counts."""
FLIP = 0.02
"""Largest error of such a pixel's colour: a step of alpha, 1/255, for colours up to four."""


def flipped(ours: RenderOutcome, exact: RenderOutcome) -> np.ndarray:
    """Return (h, w) where an image exceeds its tolerance."""
    beyond = [
        (np.abs(ours.pictures[name].astype(np.float64) - exact.pictures[name]) <= limit)
        for name, limit in PICTURES.items()
        if name in ours.pictures
    ]
    return ~np.logical_and.reduce([each.all(axis=2) if each.ndim == 3 else each for each in beyond])


def without_flips(case: RenderCase, flips: np.ndarray) -> RenderCase:
    """Return the case with the gradients of some pixels zeroed."""
    upstream = {
        name: np.where(flips[..., None] if value.ndim == 3 else flips, np.float32(0), value)
        for name, value in case.upstream.items()
    }
    return case.changed(upstream=upstream)


def picture_complaints(ours: RenderOutcome, exact: RenderOutcome) -> list[str]:
    """List the differences of images, radii and visibility from the definition."""
    found = []
    flips = flipped(ours, exact)
    if flips.sum() > max(2, FLIPPED * flips.size):
        worst = {
            name: float(np.nanmax(np.abs(ours.pictures[name] - exact.pictures[name])))
            for name in PICTURES
            if name in ours.pictures
        }
        found.append(f"{flips.sum()} of {flips.size} pixels differ, by up to {worst}")
    if not (np.abs(ours.pictures["colour"] - exact.pictures["colour"]) <= FLIP).all():
        found.append("a pixel's colour is another")
    if (ours.pictures["visible"] != exact.pictures["visible"]).any():
        found.append("others are visible")
    if not np.allclose(ours.pictures["radii"], exact.pictures["radii"], rtol=RADII, atol=RADII):
        found.append("radii differ")
    return found


def gradient_errors(ours: RenderOutcome, exact: RenderOutcome) -> dict[str, float]:
    """Return errors by parameter, relative in L2 over all Gaussians; NaN where a gradient is NaN."""
    return {
        name: float(
            np.linalg.norm(ours.gradients[name].astype(np.float64) - expected)
            / max(float(np.linalg.norm(expected)), NO_GRADIENT)
        )
        for name, expected in exact.gradients.items()
    }


def gradient_complaints(ours: RenderOutcome, exact: RenderOutcome, limit: float = GRADIENTS) -> list[str]:
    """List the gradients that differ from the definition's."""
    errors = gradient_errors(ours, exact)
    return [f"gradient of {name}: {error:.1e}" for name, error in errors.items() if not error <= limit]
