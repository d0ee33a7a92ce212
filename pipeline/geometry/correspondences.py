"""Points and directions known in two frames, the input of alignment."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int

MIN_NOISE_FACTOR = 0.3  # GNSS errors drift slowly: residuals of one flight look better than the positions are
MIN_REDUNDANT_POINTS = 8  # points from which on the residuals give the noise better than the stated sigmas do


@dataclass(frozen=True)
class SharedErrors:
    """Errors that all points of a group have in common, e.g. those of one flight.

    Attributes:
        group: Group index of each point; -1 for points without a shared error.
        sigmas: Standard deviations of each group's error, in the target's units.
    """

    group: Int[np.ndarray, " n"]
    sigmas: Float64[np.ndarray, "g 3"]

    def membership(self) -> Float64[np.ndarray, "g n"]:
        """Membership matrix: 1 where a point belongs to a group, else 0."""
        return np.asarray(self.group == np.arange(len(self.sigmas))[:, None], dtype=np.float64)


@dataclass(frozen=True)
class Correspondences:
    """The same points in two frames.

    Attributes:
        source: Coordinates in the source frame, any units.
        target: Coordinates in the target frame.
        sigmas: Standard deviations of the target's coordinates, excluding shared errors.
        shared: Target errors that groups of points share; None if there are none.
    """

    source: Float64[np.ndarray, "n 3"]
    target: Float64[np.ndarray, "n 3"]
    sigmas: Float64[np.ndarray, "n 3"]
    shared: SharedErrors | None = None

    def __len__(self) -> int:
        return len(self.source)

    def only(self, chosen: Bool[np.ndarray, " n"]) -> Correspondences:
        """The chosen points."""
        shared = None if self.shared is None else SharedErrors(self.shared.group[chosen], self.shared.sigmas)
        return Correspondences(self.source[chosen], self.target[chosen], self.sigmas[chosen], shared)

    def without(self, offsets: Float64[np.ndarray, "g 3"]) -> Correspondences:
        """A copy with the groups' shared errors subtracted from their targets."""
        if self.shared is None:
            return self
        return replace(self, target=self.target - self.shared.membership().T @ offsets)

    def at_noise(self, noise: float) -> Correspondences:
        """A copy for stated sigmas that are wrong by this factor while those of shared errors are right."""
        if self.shared is None:
            return self
        return replace(self, shared=replace(self.shared, sigmas=self.shared.sigmas / max(noise, MIN_NOISE_FACTOR)))


@dataclass(frozen=True)
class DirectionPrior:
    """Directions known in both frames, which fix a rotation that the points leave free.

    Attributes:
        source: (k, 3) unit vectors in the source frame.
        target: (k, 3) unit vectors in the target frame.
        sigma_rad: Standard deviation of each direction.
    """

    source: Float64[np.ndarray, "k 3"]
    target: Float64[np.ndarray, "k 3"]
    sigma_rad: float


@dataclass(frozen=True)
class InlierLimit:
    """The largest distance from a fit at which a point counts as an inlier.

    Attributes:
        most: In the target's units, or in multiples of the stated sigmas.
        of_sigmas: Whether it is the latter (root mean square over the three coordinates).
    """

    most: float
    of_sigmas: bool = False

    def squares(self, residuals: Float64[np.ndarray, "h n 3"], points: Correspondences) -> Float64[np.ndarray, "h n"]:
        """Squared residuals by which hypotheses are scored; accurate points count more."""
        if self.of_sigmas:
            return np.asarray(((residuals / points.sigmas) ** 2).mean(axis=2))
        importance = np.median(points.sigmas) / points.sigmas
        return np.asarray(((residuals * importance) ** 2).sum(axis=2))

    def near(self, residuals: Float64[np.ndarray, "n 3"], points: Correspondences) -> Bool[np.ndarray, " n"]:
        """Which points are inliers."""
        far = normed(residuals, points) if self.of_sigmas else np.linalg.norm(residuals, axis=1)
        return np.asarray(far <= self.most)


def normed(residuals: Float64[np.ndarray, "n 3"], points: Correspondences) -> Float64[np.ndarray, " n"]:
    """Residuals over their sigmas, root mean square over the three coordinates."""
    return np.asarray(np.sqrt(((residuals / points.sigmas) ** 2).mean(axis=1)))
