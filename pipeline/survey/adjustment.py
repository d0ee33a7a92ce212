"""Bundle adjustment with control, positions and lens priors: COLMAP's problem with additional residual blocks.

COLMAP builds the reprojection errors of the features; pyceres adds marks, control points and positions. Everything is
in world metres, in a fixed order and on one thread, so that results are bit-identical. Feature residuals stay in
pixels; all others are in units of the features' standard deviation.

Each flight's common position error is an unknown.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyceres
import pycolmap
import pycolmap.cost_functions
from jaxtyping import Float64

from splatpipe.pipeline.geometry.lens_projection import project_through_lens
from splatpipe.pipeline.geometry.similarity import Similarity, cross_matrix, fit_similarity
from splatpipe.pipeline.sfm.focal import UNOBSERVED, keep_near, posterior_focal_sigmas, solver_options
from splatpipe.pipeline.sfm.lens_blocks import hold, keep_shape
from splatpipe.pipeline.survey.local_survey import Stations

MIN_SIGMA_PX = 1.0  # of features: lens and shutter errors are correlated within a photo, and must not outweigh control
UNBOUND_M = 1e4  # sigma of a height that was not measured
FOCAL_SIGMA = 0.03  # of the focal length about its prior, relative
DISTORTION_SIGMA = 0.2  # of a distortion coefficient about its estimate from SfM
ROUNDS = 10  # of reweighting


@dataclass(frozen=True)
class Target:
    """A control point in the adjustment.

    Attributes:
        place: Surveyed position, world frame; the height is arbitrary if unknown.
        sigmas: Standard deviations, metres; infinite for unknown coordinates.
        start: Initial position, triangulated from the marks, world frame.
        marks: COLMAP image ids and pixels in the model's camera.
        mark_sigmas_px: Standard deviations of the marks, in the model's pixels.
    """

    place: Float64[np.ndarray, " 3"]
    sigmas: Float64[np.ndarray, " 3"]
    start: Float64[np.ndarray, " 3"]
    marks: Sequence[tuple[int, Float64[np.ndarray, " 2"]]]
    mark_sigmas_px: Float64[np.ndarray, " m"]


@dataclass(frozen=True)
class ControlAdjustment:
    """The result of an adjustment.

    Attributes:
        reconstruction: The adjusted model, in world metres.
        places: Adjusted positions of the targets, world frame.
        normed: Root mean square of each target's distance to its surveyed position, over its sigmas.
        offsets: Offset of each flight's positions, stated minus true, metres.
        feature_sigma_px: Standard deviation assumed for the features.
        focal_sigmas: Relative standard deviation of each camera's focal length from photos and control, by COLMAP
            camera id.
        held: Cameras whose focal length cannot be determined, so that it is held near its prior.
        usable: Whether the solver found a usable solution.
    """

    reconstruction: pycolmap.Reconstruction
    places: Float64[np.ndarray, "n 3"]
    normed: Float64[np.ndarray, " n"]
    offsets: Float64[np.ndarray, "k 3"]
    feature_sigma_px: float
    focal_sigmas: Mapping[int, float]
    held: tuple[int, ...]
    usable: bool


def can_adjust(reconstruction: pycolmap.Reconstruction) -> bool:
    """Return whether every photo has its own pose (no rigs) and there are points to adjust."""
    images = [reconstruction.images[number] for number in reconstruction.reg_image_ids()]
    return reconstruction.num_points3D() > 0 and all(image.is_ref_in_frame() for image in images)


def adjust(
    reconstruction: pycolmap.Reconstruction,
    world_from_model: Similarity,
    targets: Sequence[Target],
    stations: tuple[Stations, Float64[np.ndarray, "n 3"], Sequence[int]],
    focal_priors: Mapping[int, float],
    lenses_held: bool = False,
) -> ControlAdjustment:
    """Adjust a model to control.

    Args:
        reconstruction: In the model's frame; not modified.
        world_from_model: Approximate similarity.
        targets: Control points.
        stations: The photos' stations, their positions in the world frame, and the COLMAP ids of these photos.
        focal_priors: Focal lengths from the metadata, in the model's pixels, by camera id.
        lenses_held: Keep the interior orientation fixed.
    """
    model = pycolmap.Reconstruction(reconstruction)
    model.transform(
        pycolmap.Sim3d(
            world_from_model.scale, pycolmap.Rotation3d(world_from_model.rotation), world_from_model.translation
        )
    )
    sigma = feature_sigma(model)
    adjuster = _features(model)
    problem = adjuster.problem
    blocks = _Blocks(problem, sigma)
    places = np.array([target.start for target in targets], dtype=np.float64).reshape(-1, 3)
    for place, target in zip(places, targets, strict=True):
        blocks.add_target(model, place, target)
    offsets = _add_stations(blocks, model, stations)
    if lenses_held:
        focal_priors = {}
        blocks.kept += [hold(problem, camera, [*range(len(camera.params))]) for camera in _seen(problem, model)]
    else:
        _add_lens(blocks, model, focal_priors)
    solved = pyceres.SolverSummary()
    pyceres.solve(solver_options(len(model.reg_image_ids())), problem, solved)
    focal_sigmas = posterior_focal_sigmas(model, problem)
    held = [n for n, focal in focal_priors.items() if focal_sigmas.get(n, 0.0) > UNOBSERVED]
    if held:
        for number in held:
            keep_near(problem, model.cameras[number], focal_priors[number], FOCAL_SIGMA)
        pyceres.solve(solver_options(len(model.reg_image_ids())), problem, solved)
    normed = np.array(
        [
            math.sqrt(float((((p - t.place) / t.sigmas) ** 2).sum()) / np.isfinite(t.sigmas).sum())
            for p, t in zip(places, targets, strict=True)
        ]
    )
    model.update_point_3d_errors()
    usable = bool(solved.IsSolutionUsable()) and bool(np.isfinite(places).all())
    return ControlAdjustment(model, places, normed, offsets, sigma, focal_sigmas, tuple(held), usable)


def feature_sigma(model: pycolmap.Reconstruction) -> float:
    """Standard deviation of the features' image coordinates, from their residuals; at least one pixel."""
    errors = []
    for number in sorted(model.reg_image_ids()):
        image = model.images[number]
        camera, pose = model.cameras[image.camera_id], image.cam_from_world().matrix()
        seen = [point for point in image.points2D if point.has_point3D()]
        if not seen:
            continue
        xyz = np.array([model.points3D[point.point3D_id].xyz for point in seen])
        shown, _ = project_through_lens(camera, pose, xyz)
        errors.append(np.linalg.norm(shown - np.array([point.xy for point in seen]), axis=1))
    squares = np.concatenate([np.zeros(0), *errors]) ** 2
    squares = squares[np.isfinite(squares)]
    unknowns = 3 * model.num_points3D() + 6 * len(model.reg_image_ids())
    degrees = max(2 * len(squares) - unknowns, 1)
    return max(math.sqrt(float(squares.sum()) / degrees), MIN_SIGMA_PX)


class _Blocks:
    """Adds residual blocks, in units of the features' standard deviation, and keeps alive what Ceres points to."""

    def __init__(self, problem: Any, sigma_px: float) -> None:
        self.problem = problem
        self.sigma_px = sigma_px
        self.kept: list[object] = []

    def add(self, cost: Any, parameters: list[Float64[np.ndarray, " _"]]) -> None:
        self.kept += [cost, *parameters]
        self.problem.add_residual_block(cost, None, parameters)

    def add_prior(
        self, parameter: Float64[np.ndarray, " k"], mean: Float64[np.ndarray, " k"], sigmas: Float64[np.ndarray, " k"]
    ) -> None:
        """Add a normal prior of a parameter."""
        covariance = np.diag((sigmas / self.sigma_px) ** 2)
        self.add(pyceres.factors.NormalPrior(mean, covariance), [parameter])

    def add_target(self, model: pycolmap.Reconstruction, place: Float64[np.ndarray, " 3"], target: Target) -> None:
        """Add a control point: its surveyed position and its marks."""
        for (number, pixel), mark_sigma in zip(target.marks, target.mark_sigmas_px.tolist(), strict=True):
            image = model.images[number]
            camera = model.cameras[image.camera_id]
            covariance = np.eye(2) * (mark_sigma / self.sigma_px) ** 2
            cost = pycolmap.cost_functions.ReprojErrorCost(camera.model, covariance, pixel)
            self.add(cost, [place, image.frame.rig_from_world.params, camera.params])
        self.add_prior(place, target.place, np.minimum(target.sigmas, UNBOUND_M))


class _StationCost(pyceres.CostFunction):  # type: ignore[misc]
    """Residual of a camera centre plus its flight's offset against the photo's stated position."""

    def __init__(self, stated: Float64[np.ndarray, " 3"], weights: Float64[np.ndarray, " 3"]) -> None:
        super().__init__()
        self.set_num_residuals(3)
        self.set_parameter_block_sizes([7, 3])
        self._stated, self._weights = stated, weights

    def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:
        """Ceres' interface. Parameters: cam_from_world as quaternion (x, y, z, w) and translation, and the offset."""
        quat, t = np.asarray(parameters[0][:4]), np.asarray(parameters[0][4:])
        axis, w = -quat[:3], quat[3]  # of the inverse rotation
        turned = np.cross(axis, t)
        centre = -(t + 2.0 * w * turned + 2.0 * np.cross(axis, turned))
        residuals[:] = self._weights * (centre + np.asarray(parameters[1]) - self._stated)
        if jacobians is not None:
            if jacobians[0] is not None:
                k, jacobian = cross_matrix(axis), np.zeros((3, 7))
                jacobian[:, :3] = -2.0 * w * cross_matrix(t)
                jacobian[:, :3] += 2.0 * (axis @ t * np.eye(3) + np.outer(axis, t) - 2.0 * np.outer(t, axis))
                jacobian[:, 3] = -2.0 * turned
                jacobian[:, 4:] = -(np.eye(3) + 2.0 * w * k + 2.0 * k @ k)
                jacobians[0][:] = (self._weights[:, None] * jacobian).ravel()
            if jacobians[1] is not None:
                jacobians[1][:] = np.diag(self._weights).ravel()
        return True


def _features(model: pycolmap.Reconstruction) -> Any:
    """Return COLMAP's bundle adjuster of all photos, without a fixed gauge: control defines the datum."""
    options = pycolmap.BundleAdjustmentOptions()
    config = pycolmap.BundleAdjustmentConfig()
    for number in sorted(model.reg_image_ids()):
        config.add_image(number)
    return pycolmap.create_default_ceres_bundle_adjuster(options, config, model)


def _add_stations(
    blocks: _Blocks,
    model: pycolmap.Reconstruction,
    stations: tuple[Stations, Float64[np.ndarray, "n 3"], Sequence[int]],
) -> Float64[np.ndarray, "k 3"]:
    where, enu, numbers = stations
    offsets = np.zeros((len(where.flights), 3))
    for offset, sigmas in zip(offsets, where.offset_sigmas(), strict=True):
        blocks.add_prior(offset, np.zeros(3), sigmas)
    for k, number in enumerate(numbers):
        cost = _StationCost(enu[k], blocks.sigma_px / where.sigmas[k])
        blocks.add(cost, [model.images[number].frame.rig_from_world.params, offsets[where.group[k]]])
    return offsets


def _seen(problem: Any, model: pycolmap.Reconstruction) -> list[pycolmap.Camera]:
    """Return the cameras that take part in a problem, by id."""
    return [camera for _, camera in sorted(model.cameras.items()) if problem.has_parameter_block(camera.params)]


def _add_lens(blocks: _Blocks, model: pycolmap.Reconstruction, focal_priors: Mapping[int, float]) -> None:
    """Add lens priors from metadata and SfM, which keep parameters that neither photos nor control determine."""
    for number, camera in sorted(model.cameras.items()):
        params = camera.params
        if not blocks.problem.has_parameter_block(params):
            continue
        mean = np.array(params, dtype=np.float64)
        sigmas = np.full(len(mean), 1e6)
        for index in camera.focal_length_idxs():
            mean[index] = focal_priors.get(number, mean[index])
            sigmas[index] = FOCAL_SIGMA * mean[index]
        for index in camera.extra_params_idxs():
            sigmas[index] = DISTORTION_SIGMA
        blocks.add_prior(params, mean, sigmas)
        blocks.kept += keep_shape(blocks.problem, camera)


def moved_px(before: pycolmap.Reconstruction, after: pycolmap.Reconstruction) -> float:
    """Return how far an adjustment deformed the model, pixels: RMS displacement of the points after a best-fit
    similarity, projected into the original cameras.

    Args:
        before: The model.
        after: The adjusted model in any frame, with the same ids of points and photos.
    """
    numbers = sorted(set(before.points3D.keys()) & set(after.points3D.keys()))
    if len(numbers) < 3:
        return 0.0
    old = np.array([before.points3D[number].xyz for number in numbers])
    new = np.array([after.points3D[number].xyz for number in numbers])
    weights = np.ones(len(numbers))
    for _ in range(ROUNDS):  # distant points are seen by few photos, and would rotate the fit
        scale, rotation, translation = fit_similarity(new, old, weights)
        back = Similarity(float(scale), rotation, translation).apply(new)
        distance = np.linalg.norm(back - old, axis=1)
        weights = 1.0 / (1.0 + (distance / max(float(np.median(distance)), 1e-300)) ** 2)
    place = {number: k for k, number in enumerate(numbers)}
    squares: list[Float64[np.ndarray, " n"]] = []
    for number in sorted(before.reg_image_ids()):
        image = before.images[number]
        seen = [place[p.point3D_id] for p in image.points2D if p.has_point3D() and p.point3D_id in place]
        if not seen:
            continue
        camera, pose = before.cameras[image.camera_id], image.cam_from_world().matrix()
        shown = [project_through_lens(camera, pose, xyz[seen])[0] for xyz in (old, back)]
        squares.append(((shown[1] - shown[0]) ** 2).sum(axis=1))
    together = np.concatenate(squares)
    return float(np.sqrt(together[np.isfinite(together)].mean()))
