"""Accuracy of a model placed by positions: its coordinates, north, up and scale, in figures and in a sentence."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.geometry.similarity import similarity_jacobian
from splatpipe.pipeline.survey.placing.receiver_noise import NoisyFit, ReceiverNoise

NORMAL_95 = 1.959964
MIN_DEGREES = 3.0  # least degrees of freedom for intervals: with strong correlations, effective ones run out
MAX_PLACES = 2000  # places in the model where the accuracy of its coordinates is evaluated
DIGITS = 6


@dataclass(frozen=True)
class Uncertainty:
    """Standard deviations and 95 % bounds of a frame computed from positions.

    Attributes:
        offset_m: East, north, up of the cameras' centre, including the receiver's common error.
        north_rad: Of the heading.
        up_rad: Of the angle between the frame's up and true up (root mean square).
        scale: Relative.
        weakest_rad: Of the rotation about its weakest axis.
        coordinates_m: Horizontal (of each coordinate) and in height, of a typical place of the model.
        common_m: Horizontally and in height: the error common to all positions, included in ``coordinates_m``.
        noise: Of the positions.
        covariance: Of rotation vector, scale's logarithm and place, without the common part.
        heights_known: Whether heights were measured; else those of the figures say nothing.
    """

    offset_m: Float64[np.ndarray, " 3"]
    north_rad: float
    up_rad: float
    scale: float
    weakest_rad: float
    coordinates_m: Float64[np.ndarray, " 2"]
    common_m: Float64[np.ndarray, " 2"]
    noise: ReceiverNoise
    covariance: Float64[np.ndarray, "7 7"]
    heights_known: bool = True

    def without_heights(self, up_rad: float) -> Uncertainty:
        """The same with arbitrary heights, and an up direction that is known no better than this."""
        up, weakest = max(self.up_rad, up_rad), max(self.weakest_rad, up_rad)
        return replace(self, up_rad=up, weakest_rad=weakest, heights_known=False)

    def sentence(self) -> str:
        """The accuracy as a sentence for the user."""
        across, height = self.coordinates_m.tolist()
        metres = f"about {metres_in_words(across)}"
        if not self.heights_known:
            metres += " horizontally"
        elif not 0.67 < height / max(across, 1e-12) < 1.5:
            metres += f" ({metres_in_words(height)} in height)"
        angles = f"north to {_degrees(self.north_rad)}, up to {_degrees(self.up_rad)}"
        return f"coordinates good to {metres}, {angles}, scale to {_percent(self.scale)}"

    def as_json(self) -> dict[str, Any]:
        """The entry in `frame.json` and `accuracy.json`: standard deviations, 95 % bounds, noise and the sentence."""
        horizontal, vertical = (student_95(float(degrees)) for degrees in self.noise.degrees)
        weakest = max(horizontal, vertical)
        times = np.array([horizontal, horizontal, vertical])
        return {
            "sentence": self.sentence(),
            "coordinates_sigma_m": _rounded(self.coordinates_m),
            "offset_sigma_m": _rounded(self.offset_m),
            "offset_95_m": _rounded(times * self.offset_m),
            "north_sigma_deg": _rounded(math.degrees(self.north_rad)),
            "north_95_deg": _rounded(horizontal * math.degrees(self.north_rad)),
            "up_sigma_deg": _rounded(math.degrees(self.up_rad)),
            "up_95_deg": _rounded(weakest * math.degrees(self.up_rad)),
            "scale_sigma_percent": _rounded(100.0 * self.scale),
            "scale_95_percent": _rounded(100.0 * horizontal * self.scale),
            "noise_over_stated": _rounded(self.noise.factors),
            "noise_correlation": _rounded(self.noise.correlations),
            "common_m": _rounded(self.common_m),
        }


def uncertainty_of(
    fit: NoisyFit,
    source: Float64[np.ndarray, "n 3"],
    places: Float64[np.ndarray, "m 3"],
    stated: Float64[np.ndarray, " 2"],
) -> Uncertainty:
    """Estimate the accuracy of a fit of positions.

    Residuals do not show an error common to all positions. A receiver's stated accuracy covers the whole error, so the
    part that the residuals do not show is assumed to be common: a flight whose positions agree to 0.4 m of stated 3 m
    lies somewhere within 3 m. If positions scatter by more than stated, the residuals show all of it.

    Args:
        fit: Of the positions.
        source: Positions of the cameras used, in the model.
        places: Positions of the model's points.
        stated: Stated accuracy, horizontally and in height (metres); zeros where the fit includes the flights' offsets,
            which already account for it.
    """
    spread = 2.0 * np.sqrt(2.0 / np.maximum(fit.noise.degrees, 1.0))
    # Upper bound of the noise's share of the stated variance: no common error is left if the noise is as stated.
    variance_bound = fit.noise.factors**2 * (1.0 + spread)
    common = stated * np.sqrt(np.maximum(1.0 - variance_bound, 0.0))
    common_3 = common[[0, 0, 1]]
    covariance = fit.covariance
    tilt = covariance[:2, :2]
    chosen = places[:: max(1, len(places) // MAX_PLACES)] if len(places) else source
    reach = similarity_jacobian(fit.similarity, chosen, about=source.mean(axis=0))
    variances = np.einsum("nkp,pq,nkq->nk", reach, covariance, reach)
    typical = np.median(variances, axis=0) + common_3**2
    return Uncertainty(
        offset_m=np.sqrt(np.diag(covariance)[4:] + common_3**2),
        north_rad=math.sqrt(covariance[2, 2]),
        up_rad=math.sqrt(float(np.trace(tilt))),
        scale=math.sqrt(covariance[3, 3]),
        weakest_rad=math.sqrt(float(np.linalg.eigvalsh(covariance[:3, :3])[-1])),
        coordinates_m=np.sqrt(np.array([typical[:2].mean(), typical[2]])),
        common_m=common,
        noise=fit.noise,
        covariance=covariance,
    )


def student_95(degrees: float) -> float:
    """Two-sided 95 % quantile of Student's t (Abramowitz and Stegun, Handbook, 1964, 26.7.5)."""
    z, n = NORMAL_95, max(degrees, MIN_DEGREES)
    first = (z**3 + z) / 4.0
    second = (5.0 * z**5 + 16.0 * z**3 + 3.0 * z) / 96.0
    third = (3.0 * z**7 + 19.0 * z**5 + 17.0 * z**3 - 15.0 * z) / 384.0
    return z + first / n + second / n**2 + third / n**3


def metres_in_words(value: float) -> str:
    """A length in cm or m, to two digits."""
    if value < 0.0995:
        return f"{max(100.0 * value, 0.1):.2g} cm"
    return f"{value:.2g} m" if value < 99.5 else f"{value:,.0f} m"


def _degrees(value: float) -> str:
    return f"{max(math.degrees(value), 0.01):.2g}°"


def _percent(value: float) -> str:
    return f"{max(100.0 * value, 0.01):.2g} %"


def _rounded(value: Any) -> Any:
    return np.round(np.asarray(value, dtype=np.float64), DIGITS).tolist()
