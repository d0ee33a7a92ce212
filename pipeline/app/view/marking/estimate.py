"""Estimates from the marks so far: each point's position, the frame's accuracy, and where photos show the other points.

It uses georef's own fit, without its bundle adjustment: control and positions together, with blunder detection.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float64

from splatpipe.pipeline.app.view.marking.marking_job import MarkingJob
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.stage import JSON
from splatpipe.pipeline.geometry.joint_fit import JointFit
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.survey.control.accuracy import GeoreferencedModel, accuracy_json
from splatpipe.pipeline.survey.control.blunders import require_near
from splatpipe.pipeline.survey.control.control_fit import fit_control
from splatpipe.pipeline.survey.control.local_survey import LocalSurvey, stations_of
from splatpipe.pipeline.survey.files.control_file import ControlFile
from splatpipe.pipeline.survey.placing.fitting import FrameUndeterminedError
from splatpipe.pipeline.survey.placing.model import SparseModel
from splatpipe.pipeline.survey.points.located_points import Sighting, SurveyPoint, locate, residual_px
from splatpipe.pipeline.survey.points.surveyed_points import Survey, with_roles

Marks = Mapping[str, Mapping[str, tuple[float, float]]]
UNKNOWN_HEIGHT_M = 5.0  # standard deviation of an unknown height, or while the vertical datum is unknown
MIN_RADIUS_PX = 6.0
SURFACE_RADIUS_M = 8.0  # around a point: its height is taken from the sparse points within
MIN_NEAR = 3  # sparse points needed for a height
RAY_TOLERANCE = 1e-3  # error in x/z beyond which the lens model has folded a ray outside the image back into it
# Times a photo's nearest and farthest sparse point depths: the range in which a mark's ray is followed.
DEPTH_RANGE_FACTORS = np.array([0.5, 2.0])
LINE_STEPS = 48  # along the ray: lens distortion bends its image
NEIGHBOURS = 30  # sparse points around a place: in a photo that shows none of them, the place is most likely occluded
MAX_WITNESSES = 50_000  # sparse points searched for them
HELPFUL_MARKS = 4  # marks of a point beyond which further ones add little


@dataclass
class WarningCollector:
    """A reporter that keeps the warnings."""

    warnings: list[str] = field(default_factory=list)

    def progress(self, done: float, total: float, what: str, unit: str = "") -> None:
        """Ignore progress."""

    def metric(self, name: str, value: float, step: int | None = None) -> None:
        """Ignore a metric."""

    def note(self, message: str) -> None:
        """Ignore a note."""

    def warning(self, message: str, hint: str = "") -> None:
        self.warnings.append(f"{message} {hint}".strip())


@dataclass(frozen=True)
class Estimate:
    """The estimated points and frame.

    Attributes:
        survey: The points with their marks, roles and positions in the model.
        tables: As in `accuracy.json`; empty without a frame.
        expected_m: Standard deviation of the frame, horizontal and vertical, median over the model (without control,
            from the stated accuracy of the positions); None if unknown.
        heights_tied: Whether heights are tied to the survey: a control point with a height took part.
        gsd_m: Ground sampling distance; None without a frame.
        places: Positions of the points in the model, from their marks or else from the survey; NaN if unknown.
        radius_m: Their uncertainty in the model's units; 0 if from marks.
        by_marks: Which are known from marks.
        residual_m: East, north, up of each point, estimated minus surveyed; NaN if unknown.
        warnings: Warnings in sentences.
    """

    survey: Survey
    tables: Mapping[str, JSON]
    expected_m: tuple[float, float] | None
    heights_tied: bool
    gsd_m: float | None
    places: Float64[np.ndarray, "n 3"]
    radius_m: Float64[np.ndarray, " n"]
    by_marks: Bool[np.ndarray, " n"]
    residual_m: Float64[np.ndarray, "n 3"]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class _GeoreferencedSite:
    site: LocalSurvey
    fit: JointFit
    survey: Survey


class Estimator:
    """Estimates points and frame from marks; points with unchanged marks are not triangulated again.

    Args:
        job: The marking job.

    Raises:
        SplatpipeError: if the points are far from the photos.
    """

    def __init__(self, job: MarkingJob) -> None:
        self._job = job
        self._index = {name: k for k, name in enumerate(job.model.names)}
        self._located: dict[str, tuple[object, SurveyPoint]] = {}
        self._stations = stations_of(job.model, job.positions, job.frame)
        unmarked = [SurveyPoint(point, "control", "", ()) for point in job.points]
        self._geodetic = require_near(self._survey(unmarked), job.config, self._stations)
        self._gsd = job.model.gsd(1.0)  # in the model's units: slow to compute, and independent of marks

    def estimate(self, marks: Marks) -> Estimate:
        """Compute the estimate for some marks.

        Args:
            marks: Pixel coordinates by point and photo; (0, 0) is the top-left corner of the first pixel.
        """
        job, collector = self._job, WarningCollector()
        points = [self._locate(k, marks.get(point.name, {})) for k, point in enumerate(job.points)]
        survey = self._survey(points)
        try:
            fitted = self._fit(survey, collector)
        except (FrameUndeterminedError, SplatpipeError) as error:
            if has_enough_marks(points):
                collector.warnings.append(
                    str(error) if isinstance(error, SplatpipeError) else f"No frame yet: {error}."
                )
            fitted = None
        survey = fitted.survey if fitted is not None else survey
        located = [point.found for point in survey.points]
        by_marks = np.array([found is not None for found in located], dtype=bool)
        places = np.array([np.full(3, np.nan) if found is None else found.xyz for found in located]).reshape(-1, 3)
        radius, residual = np.zeros(len(points)), np.full((len(points), 3), np.nan)
        if fitted is None:
            return Estimate(
                survey, {}, None, False, None, places, radius, by_marks, residual, tuple(collector.warnings)
            )
        site, similarity = fitted.site, fitted.fit.similarity
        known = np.isfinite(site.targets.sigmas)
        residual[by_marks] = np.where(
            known[by_marks], similarity.apply(places[by_marks]) - site.targets.enu[by_marks], np.nan
        )
        places[~by_marks], radius[~by_marks] = self._expected(fitted, ~by_marks)
        gsd = None if self._gsd is None else self._gsd * similarity.scale
        placed = GeoreferencedModel(job.model, similarity, fitted.fit.offsets)
        tables = accuracy_json(survey, site, placed, gsd)["tables"]
        sigmas = self._sigmas(fitted)
        tied = any(point.surveyed.z is not None for point in survey.of_role("control"))
        return Estimate(
            survey, tables, sigmas, tied, gsd, places, radius, by_marks, residual, tuple(collector.warnings)
        )

    def _locate(self, number: int, marks: Mapping[str, tuple[float, float]]) -> SurveyPoint:
        job, point = self._job, self._job.points[number]
        seen = tuple(Sighting(photo, marks[photo], self._index.get(photo)) for photo in sorted(marks))
        before = self._located.get(point.name)
        if before is not None and before[0] == seen:
            return before[1]
        found = locate(SurveyPoint(point, "control", "", seen), job.model, job.photos, job.config.mark_sigma_px)
        self._located[point.name] = (seen, found)
        return found

    def _survey(self, points: list[SurveyPoint]) -> Survey:
        job = self._job
        file = ControlFile(job.text.path.name, job.crs, job.points, ())
        return Survey(file, tuple(with_roles(points, job.config.check_points)))

    def _fit(self, survey: Survey, collector: WarningCollector) -> _GeoreferencedSite:
        job, stations = self._job, self._stations
        marked = bool(survey.of_role("control"))
        fitted = fit_control(
            survey,
            self._geodetic,
            stations,
            (job.model, job.positions, job.frame),
            job.config,
            collector,
            None if marked else self._shift_to_points,
        )
        fit = fitted.fit if fitted.survey.of_role("control") else replace(fitted.fit, similarity=fitted.start[0])
        return _GeoreferencedSite(fitted.site, fit, fitted.survey)

    def _shift_to_points(self, similarity: Similarity, site: LocalSurvey) -> Similarity:
        """Before any mark: shift the model vertically so that the points lie on it, whatever their datums."""
        cloud = similarity.apply(self._job.model.points)
        lifts = []
        for place in site.targets.enu[np.isfinite(site.targets.sigmas[:, 2])]:
            near = np.linalg.norm(cloud[:, :2] - place[:2], axis=1) < SURFACE_RADIUS_M
            if near.sum() >= MIN_NEAR:
                lifts.append(place[2] - np.median(cloud[near, 2]))
        lift = float(np.median(lifts)) if lifts else 0.0
        return replace(similarity, translation=similarity.translation + np.array([0.0, 0.0, lift]))

    def _expected(
        self, fitted: _GeoreferencedSite, wanted: Bool[np.ndarray, " n"]
    ) -> tuple[Float64[np.ndarray, "m 3"], Float64[np.ndarray, " m"]]:
        """The surveyed points' positions in the model, and their uncertainty, in the model's units."""
        similarity, enu = fitted.fit.similarity, fitted.site.targets.enu[wanted].copy()
        unknown = ~np.isfinite(fitted.site.targets.sigmas[wanted, 2])
        cloud = similarity.apply(self._job.model.points)
        if len(cloud):
            enu[unknown, 2] = np.median(cloud[:, 2])
        places = similarity.inverse().apply(enu)
        if not fitted.survey.of_role("control"):
            return places, np.full(len(places), np.linalg.norm(self._stated_sigmas()) / similarity.scale)
        sigmas = fitted.fit.sigmas_at(places) * max(fitted.fit.noise, 1.0)
        sigmas[:, 2] = np.minimum(np.where(unknown, UNKNOWN_HEIGHT_M, sigmas[:, 2]), UNKNOWN_HEIGHT_M)
        return places, np.linalg.norm(sigmas, axis=1) / similarity.scale

    def _stated_sigmas(self) -> Float64[np.ndarray, " 3"]:
        """Standard deviations of a frame from the photos' positions alone, which share most of their errors."""
        return np.asarray(np.median(self._stations.sigmas, axis=0))

    def _sigmas(self, fitted: _GeoreferencedSite) -> tuple[float, float]:
        """Horizontal and vertical standard deviations of the frame: the median over the model."""
        if not fitted.survey.of_role("control"):
            east, north, up = self._stated_sigmas().tolist()
            return math.hypot(east, north), up
        model = self._job.model
        around = model.points if len(model.points) else model.centres
        chosen = around[:: max(1, len(around) // 500)]
        sigmas = fitted.fit.sigmas_at(chosen) * max(fitted.fit.noise, 1.0)
        return float(np.median(np.hypot(sigmas[:, 0], sigmas[:, 1]))), float(np.median(sigmas[:, 2]))


def has_enough_marks(points: list[SurveyPoint]) -> bool:
    """Whether enough points are marked that a frame should exist."""
    return sum(point.found is not None for point in points) >= 3


@dataclass(frozen=True)
class Projection:
    """Projections of the points into the photos.

    Attributes:
        pixels: Image coordinates of each point in each photo of the model; NaN if not shown.
        radius_px: Search radius around them.
        depth: Depths in the model's units.
        doubtful: Whether a point is just outside the image, or seems to be occluded.
    """

    pixels: Float64[np.ndarray, "n m 2"]
    radius_px: Float64[np.ndarray, "n m"]
    depth: Float64[np.ndarray, "n m"]
    doubtful: Bool[np.ndarray, "n m"]


class Projector:
    """Projects points into photos.

    Args:
        job: The marking job.
    """

    def __init__(self, job: MarkingJob) -> None:
        self._job = job
        self._cloud, self._shows = _cloud_of(job.model)

    def project(self, places: Float64[np.ndarray, "n 3"], radius_m: Float64[np.ndarray, " n"]) -> Projection:
        """Project positions in the model, with uncertainty radii in its units, into all photos."""
        count, photos = len(places), len(self._job.model.names)
        pixels = np.full((count, photos, 2), np.nan)
        radius, depth = np.full((count, photos), np.nan), np.full((count, photos), np.nan)
        doubtful, witnessed = np.zeros((count, photos), dtype=bool), self._witnessed(places)
        for index, name in enumerate(self._job.model.names):
            photo = self._job.photos.get(name)
            if photo is None:
                continue
            view = self._job.model.view(index, photo.width)
            seen = places @ view.cam_from_model[:, :3].T + view.cam_from_model[:, 3]
            ahead = np.flatnonzero(np.isfinite(seen).all(axis=1) & (seen[:, 2] > 0.0))
            if len(ahead) == 0:
                continue
            projected = np.asarray(view.camera.img_from_cam(seen[ahead]), np.float64).reshape(-1, 2)
            back = np.asarray(view.camera.cam_from_img(projected), np.float64).reshape(-1, 2)
            true = np.abs(back - seen[ahead, :2] / seen[ahead, 2:]).max(axis=1) < RAY_TOLERANCE
            projected = projected / view.scale
            focal = view.camera.mean_focal_length() / view.scale
            spread = np.maximum(MIN_RADIUS_PX, focal * radius_m[ahead] / seen[ahead, 2])
            margin = np.minimum(spread, 0.25 * photo.width)[:, None]
            inside = true & (
                (projected >= -margin) & (projected <= np.array([photo.width, photo.height]) + margin)
            ).all(axis=1)
            rows = ahead[inside]
            pixels[rows, index], radius[rows, index], depth[rows, index] = (
                projected[inside],
                spread[inside],
                seen[rows, 2],
            )
            beyond = ((projected[inside] < 0.0) | (projected[inside] > [photo.width, photo.height])).any(axis=1)
            doubtful[rows, index] = beyond | ~witnessed[rows, index]
        return Projection(pixels, radius, depth, doubtful)

    def line(self, sighting: Sighting) -> Float64[np.ndarray, "steps m 2"]:
        """Project the ray of a mark in one photo into the others (the epipolar curve); NaN where not visible.

        A curve ends with the first position outside the photo, so that it reaches the photo's edge.
        """
        assert sighting.index is not None
        view = self._job.model.view(sighting.index, self._job.photos[sighting.photo].width)
        pose = view.cam_from_model
        depths = self._cloud[self._shows[:, sighting.index]] @ pose[2, :3] + pose[2, 3]
        reach = np.percentile(depths, [5.0, 95.0]) * DEPTH_RANGE_FACTORS if len(depths) else np.array([0.1, 10.0])
        ray = np.append(view.ray(np.array(sighting.pixel)), 1.0)
        near, far = np.maximum(reach, 1e-9).tolist()
        places = (np.geomspace(near, far, LINE_STEPS)[:, None] * ray - pose[:, 3]) @ pose[:, :3]
        pixels = self.project(places, np.full(LINE_STEPS, np.inf)).pixels
        photos = [self._job.photos.get(name) for name in self._job.model.names]
        sizes = np.array([(0, 0) if photo is None else (photo.width, photo.height) for photo in photos])
        inside = np.all((pixels >= 0.0) & (pixels <= sizes), axis=2)
        near_inside = inside.copy()
        near_inside[1:] |= inside[:-1]
        near_inside[:-1] |= inside[1:]
        return np.where(near_inside[..., None], pixels, np.nan)

    def _witnessed(self, places: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n m"]:
        """Which photos show a sparse point close to each position, so that it is probably not occluded there."""
        count = min(NEIGHBOURS, len(self._cloud))
        if count == 0:
            return np.ones((len(places), self._shows.shape[1]), dtype=bool)
        witnessed = np.zeros((len(places), self._shows.shape[1]), dtype=bool)
        for k in np.flatnonzero(np.isfinite(places).all(axis=1)):
            away = ((self._cloud - places[k]) ** 2).sum(axis=1)
            witnessed[k] = self._shows[np.argpartition(away, count - 1)[:count]].any(axis=0)
        return witnessed


def _cloud_of(model: SparseModel) -> tuple[Float64[np.ndarray, "k 3"], Bool[np.ndarray, "k m"]]:
    """Sparse points, evenly thinned if there are many, and which photos show each."""
    every = sorted(model.reconstruction.points3D.items())
    chosen = [point for _, point in every[:: max(1, len(every) // MAX_WITNESSES)]]
    number = {image: k for k, image in enumerate(model.image_ids)}
    shows = np.zeros((len(chosen), len(model.image_ids)), dtype=bool)
    for row, point in enumerate(chosen):
        seen = (number.get(element.image_id) for element in point.track.elements)
        shows[row, [k for k in seen if k is not None]] = True
    return np.array([point.xyz for point in chosen], dtype=np.float64).reshape(-1, 3), shows


def residual_of(sighting: Sighting, point: SurveyPoint, job: MarkingJob) -> list[float] | None:
    """Reprojection error at a mark, projected minus marked, pixels; None if unknown."""
    if point.found is None:
        return None
    found = residual_px(sighting, point.found.xyz, job.model, job.photos)
    return None if found is None else found.tolist()
