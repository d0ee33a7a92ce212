"""How well a reconstruction determines its focal lengths: their standard deviation with everything else unknown.

In nadir photos of flat ground from one height, focal length and flying height are not separable. The formal standard
deviation shows this, but is far too small by itself: feature errors within a photo are correlated, and a real lens
deviates from its model. So features count as known to a pixel, and the principal point as free by a hundredth of the
width. That separates real captures well: 0.01 to 0.07 % with oblique photos, 3 % on a flat nadir flight.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
import pyceres
import pycolmap

from splatpipe.pipeline.sfm.lenses.lens_blocks import keep_shape
from splatpipe.pipeline.sfm.mapping.completion import ROBUST_PX
from splatpipe.pipeline.sfm.model.pixel_tolerance_scale import pixel_tolerance_scale

MAX_UNOBSERVED_DEVIATION = 0.03  # relative deviation allowed for a focal length that the photos do not determine
UNOBSERVED = 0.01  # relative standard deviation above which the photos do not determine a focal length
PRINCIPAL_POINT_SIGMA = 0.01  # prior standard deviation of the principal point over the image width
MAX_DENSE = 60  # photos up to which the reduced system is solved densely
MAX_ITERATIONS = 60
FUNCTION_TOLERANCE = 1e-6
ENOUGH_POINTS = 15_000  # of a model, which usually show that its focal lengths are determined
EXTRA_SIGMA = 0.2  # prior standard deviation of a distortion coefficient: no lens has larger ones


def focal_sigmas(model: pycolmap.Reconstruction) -> dict[int, float]:
    """Estimate the relative standard deviation of each camera's focal length from its features alone.

    Args:
        model: In any frame; not modified.

    Returns:
        By COLMAP's camera id; cameras whose focal length is undetermined are missing.
    """
    copy = pycolmap.Reconstruction(model)
    copy.tear_down()  # drops photos that are not placed: COLMAP's covariance needs every photo's pose
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    config = pycolmap.BundleAdjustmentConfig()
    for number in sorted(copy.reg_image_ids()):
        config.add_image(number)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, copy)
    kept: list[object] = []
    for _, camera in sorted(copy.cameras.items()):
        if not adjuster.problem.has_parameter_block(camera.params):
            continue
        sigmas = np.full(len(camera.params), 1e6)
        sigmas[list(camera.principal_point_idxs())] = PRINCIPAL_POINT_SIGMA * camera.width
        sigmas[list(camera.extra_params_idxs())] = EXTRA_SIGMA
        prior = pyceres.factors.NormalPrior(np.array(camera.params), np.diag(sigmas**2))
        kept.append(prior)
        adjuster.problem.add_residual_block(prior, None, [camera.params])
        kept += keep_shape(adjuster.problem, camera, principal_point=True)
    return posterior_focal_sigmas(copy, adjuster.problem)


def undetermined_sigma(model: pycolmap.Reconstruction, cameras: Collection[int]) -> float:
    """Return the largest relative standard deviation of some focal lengths; 0 if the photos determine all of them.

    Some of the points are asked first: what they determine, all points determine, and a covariance of all takes more
    memory than any other step of the stage.

    Args:
        model: In any frame; not modified.
        cameras: COLMAP's ids.
    """
    points = sorted(model.points3D)
    step = -(-len(points) // ENOUGH_POINTS)
    asked = [model]
    if step > 1:
        fewer = pycolmap.Reconstruction(model)
        for place, number in enumerate(points):
            if place % step:
                fewer.delete_point3D(number)
        asked = [fewer, model]
    for each in asked:
        sigmas = focal_sigmas(each)
        worst = max((sigmas.get(number, math.inf) for number in cameras), default=0.0)
        if worst <= UNOBSERVED:
            return 0.0
    return worst


def adjust_within(model: pycolmap.Reconstruction, focals: Mapping[int, float], share: float) -> None:
    """Adjust a model in place with focal lengths bounded around given values, on one thread.

    Args:
        model: The model; its scale and position may change.
        focals: Known focal lengths, pixels, by COLMAP's camera id.
        share: Maximum relative deviation from them.
    """
    config = pycolmap.BundleAdjustmentConfig()
    for number in sorted(model.reg_image_ids()):
        config.add_image(number)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = pycolmap.BundleAdjustmentOptions()
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY  # as in the last adjustment of mapping
    options.ceres.loss_function_scale = ROBUST_PX * pixel_tolerance_scale(model.cameras.values())
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    kept = [keep_shape(adjuster.problem, camera) for _, camera in sorted(model.cameras.items())]
    for number, focal in sorted(focals.items()):
        keep_near(adjuster.problem, model.cameras[number], focal, share)
    pyceres.solve(solver_options(len(model.reg_image_ids())), adjuster.problem, pyceres.SolverSummary())
    del kept
    model.update_point_3d_errors()


def keep_near(problem: Any, camera: pycolmap.Camera, focal_px: float, share: float) -> None:
    """Start a problem's focal length at a given value, and bound its relative deviation from that."""
    params = camera.params
    if problem.has_parameter_block(params):
        for index in camera.focal_length_idxs():
            params[index] = focal_px
            problem.set_parameter_lower_bound(params, index, (1.0 - share) * focal_px)
            problem.set_parameter_upper_bound(params, index, (1.0 + share) * focal_px)


def solver_options(photos: int) -> Any:
    """Return Ceres' options for a bundle adjustment of ``photos`` photos: one thread, bitwise reproducible."""
    options = pyceres.SolverOptions()
    options.num_threads = 1
    options.linear_solver_type = (
        pyceres.LinearSolverType.DENSE_SCHUR if photos <= MAX_DENSE else pyceres.LinearSolverType.SPARSE_SCHUR
    )
    options.max_num_iterations = MAX_ITERATIONS
    options.function_tolerance = FUNCTION_TOLERANCE
    options.minimizer_progress_to_stdout = False
    options.logging_type = pyceres.LoggingType.SILENT
    return options


def posterior_focal_sigmas(model: pycolmap.Reconstruction, problem: Any) -> dict[int, float]:
    """Estimate relative standard deviations of focal lengths from a Ceres problem with feature residuals in pixels.

    Args:
        model: The model whose parameters the problem optimises.
        problem: A pyceres problem as COLMAP builds it, possibly with blocks added.

    Returns:
        By COLMAP's camera id, as ``focal_sigmas``.
    """
    options = pycolmap.BACovarianceOptions()
    options.params = pycolmap.BACovarianceOptionsParams.ALL
    covariance = pycolmap.estimate_ba_covariance_from_problem(options, model, problem)
    result: dict[int, float] = {}
    for number, camera in sorted(model.cameras.items()):
        block = None if covariance is None else covariance.get_other_params_cov(camera.params)
        if block is not None and math.isfinite(float(block[0, 0])):  # the focal length comes first in every model
            result[number] = math.sqrt(max(float(block[0, 0]), 0.0)) / float(camera.mean_focal_length())
    return result
