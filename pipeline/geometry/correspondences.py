"""Points and directions that are known in two frames, as alignment takes them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int

LEAST_NOISE_FACTOR = 0.3  # GNSS errors change slowly: residuals of one flight look better than the positions are
REDUNDANT = 8  # points from which on the residuals tell the noise better than the stated sigmas do


@dataclass(frozen=True)
class SharedErrors:
    """Errors that points of a group have in common, e.g. those of one flight.

    Attributes:
        group: Of each point; -1 for those that share nothing.
        sigmas: Standard deviations of each group's error, in the target's units.
    """

    group: Int[np.ndarray, " n"]
    sigmas: Float64[np.ndarray, "g 3"]

    def membership(self) -> Float64[np.ndarray, "g n"]:
        """1 where a point is of a group, else 0."""
        return np.asarray(self.group == np.arange(len(self.sigmas))[:, None], dtype=np.float64)


@dataclass(frozen=True)
class Correspondences:
    """The same points in two frames.

    Attributes:
        source: In the source frame, any units.
        target: In the target frame.
        sigmas: Standard deviations of the target's coordinates, besides what they share.
        shared: Errors of the target that groups of points share; None without any.
    """

    source: Float64[np.ndarray, "n 3"]
    target: Float64[np.ndarray, "n 3"]
    sigmas: Float64[np.ndarray, "n 3"]
    shared: SharedErrors | None = None

    def __len__(self) -> int:
        return len(self.source)

    def only(self, chosen: Bool[np.ndarray, " n"]) -> Correspondences:
        """Some of them."""
        shared = None if self.shared is None else SharedErrors(self.shared.group[chosen], self.shared.sigmas)
        return Correspondences(self.source[chosen], self.target[chosen], self.sigmas[chosen], shared)

    def without(self, offsets: Float64[np.ndarray, "g 3"]) -> Correspondences:
        """The same without what groups have in common, which is taken off their targets."""
        if self.shared is None:
            return self
        return replace(self, target=self.target - self.shared.membership().T @ offsets)

    def at_noise(self, noise: float) -> Correspondences:
        """The same where the stated sigmas are wrong by this factor, and those of shared errors are not."""
        if self.shared is None:
            return self
        return replace(self, shared=replace(self.shared, sigmas=self.shared.sigmas / max(noise, LEAST_NOISE_FACTOR)))


@dataclass(frozen=True)
class DirectionPrior:
    """Directions known in both frames, which hold a rotation that points leave free.

    Attributes:
        source: (k, 3) unit vectors.
        target: (k, 3) unit vectors.
        sigma_rad: Standard deviation of each.
    """

    source: Float64[np.ndarray, "k 3"]
    target: Float64[np.ndarray, "k 3"]
    sigma_rad: float


@dataclass(frozen=True)
class InlierLimit:
    """How far points may be from a fit that they agree with.

    Attributes:
        most: In the target's units, or times the stated sigmas.
        of_sigmas: Whether it is the latter (root mean square of the three coordinates).
    """

    most: float
    of_sigmas: bool = False

    def squares(self, residuals: Float64[np.ndarray, "h n 3"], points: Correspondences) -> Float64[np.ndarray, "h n"]:
        """What hypotheses are scored by; accurate points count more."""
        if self.of_sigmas:
            return np.asarray(((residuals / points.sigmas) ** 2).mean(axis=2))
        importance = np.median(points.sigmas) / points.sigmas
        return np.asarray(((residuals * importance) ** 2).sum(axis=2))

    def near(self, residuals: Float64[np.ndarray, "n 3"], points: Correspondences) -> Bool[np.ndarray, " n"]:
        """Which points agree."""
        far = normed(residuals, points) if self.of_sigmas else np.linalg.norm(residuals, axis=1)
        return np.asarray(far <= self.most)


def normed(residuals: Float64[np.ndarray, "n 3"], points: Correspondences) -> Float64[np.ndarray, " n"]:
    """Residuals over their sigmas, root mean square of the three coordinates."""
    return np.asarray(np.sqrt(((residuals / points.sigmas) ** 2).mean(axis=1)))
