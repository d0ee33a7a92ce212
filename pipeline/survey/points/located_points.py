"""A surveyed point's marks in photos, and the place in the model where their rays meet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.geometry.triangulation import Rays, TriangulatedPoint, triangulate
from splatpipe.pipeline.photos.files.photo_list import Photo
from splatpipe.pipeline.survey.files.control_file import SurveyedPoint
from splatpipe.pipeline.survey.placing.model import SparseModel

MAX_MARK_SIGMAS = 10.0  # error of a mark over the marks' sigma, at most
MIN_TOLERANCE_PX = 5.0  # least error of a mark to be wrong: SfM's own errors at the edge of a photo
MAX_ERROR_RATIO = 8.0  # error of a mark over the model's mean reprojection error, at most


@dataclass(frozen=True)
class Sighting:
    """A mark of a point in a photo.

    Attributes:
        photo: Its name.
        pixel: In the stored grid; (0, 0) is the top-left corner of the first pixel.
        index: Of the photo in the model; None where the photo has no pose.
        agrees: Whether the mark was used to triangulate the point.
        automatic: Whether it is a detected target rather than a mark made by hand.
    """

    photo: str
    pixel: tuple[float, float]
    index: int | None
    agrees: bool = True
    automatic: bool = False


@dataclass(frozen=True)
class SurveyPoint:
    """A surveyed point.

    Attributes:
        surveyed: As in the file.
        role: Control point, check point, or left out.
        why: The reason if it is left out, as a clause.
        sightings: Its marks, in the order of the photos' names.
        found: Its triangulated position in the model; None where its marks do not determine it.
    """

    surveyed: SurveyedPoint
    role: Literal["control", "check", "left_out"]
    why: str
    sightings: tuple[Sighting, ...]
    found: TriangulatedPoint | None = None

    @property
    def name(self) -> str:
        """Its name."""
        return self.surveyed.name

    def left_out(self, why: str) -> SurveyPoint:
        """The same point, left out."""
        return replace(self, role="left_out", why=why)


def locate(point: SurveyPoint, model: SparseModel, photos: Mapping[str, Photo], mark_sigma_px: float) -> SurveyPoint:
    """Triangulate a point in the model from its marks; left out where they do not determine it."""
    placed = [k for k, sighting in enumerate(point.sightings) if sighting.index is not None]
    if len(placed) < 2:
        return point.left_out(_why_unseen(point, len(placed)))
    rays, error_px = _rays([point.sightings[k] for k in placed], model, photos)
    good = np.isfinite(rays.rays).all(axis=1) & np.isfinite(rays.pixels).all(axis=(1, 2))
    tolerance = max(MIN_TOLERANCE_PX, MAX_MARK_SIGMAS * mark_sigma_px, MAX_ERROR_RATIO * error_px)
    found = triangulate(rays.only(good), tolerance) if good.sum() >= 2 else None
    if found is None:
        many = "two marks" if len(placed) == 2 else f"{len(placed)} marks"
        return point.left_out(
            f"its {many} do not meet in one point: one is wrong, or the photos are too close together"
        )
    agrees = np.zeros(len(placed), dtype=bool)
    agrees[good] = found.agree
    sightings = list(point.sightings)
    for k, agree in zip(placed, agrees.tolist(), strict=True):
        sightings[k] = replace(sightings[k], agrees=agree)
    return replace(point, sightings=tuple(sightings), found=found)


def _rays(sightings: Sequence[Sighting], model: SparseModel, photos: Mapping[str, Photo]) -> tuple[Rays, float]:
    """Rays of marks in photos of the model, and the model's mean reprojection error in the photos' pixels."""
    views = [model.view(s.index, photos[s.photo].width) for s in sightings if s.index is not None]
    rays = np.stack([view.ray(np.array(s.pixel)) for view, s in zip(views, sightings, strict=True)])
    poses = np.stack([view.cam_from_model for view in views])
    pixels = np.stack([view.pixels_by_ray(ray) for view, ray in zip(views, rays, strict=True)])
    error_px = model.reconstruction.compute_mean_reprojection_error() / min(view.scale for view in views)
    return Rays(poses, rays, pixels), error_px


def residual_px(
    sighting: Sighting, place: Float64[np.ndarray, " 3"], model: SparseModel, photos: Mapping[str, Photo]
) -> Float64[np.ndarray, " 2"] | None:
    """Reprojection error: a place of the model projected into a photo, less its mark (pixels); None if not visible."""
    if sighting.index is None:
        return None
    residual = model.view(sighting.index, photos[sighting.photo].width).pixel(place) - np.array(sighting.pixel)
    return residual if np.isfinite(residual).all() else None


def _why_unseen(point: SurveyPoint, placed: int) -> str:
    count = len(point.sightings)
    if count == 0:
        return "it is marked in no photo of this capture"
    if placed < count and placed < 2 <= count:
        return f"only {placed} of the {count} photos that it is marked in could be placed"
    return "it is marked in one photo only" if placed else "the photo that it is marked in could not be placed"
