"""Bundle adjustment of chosen lens parameters with priors, on one thread.

COLMAP frees the same groups of parameters for all cameras; here each camera has its own, through Ceres' manifolds. The
wide models have two focal lengths, whose ratio is kept, and FULL_OPENCV has a denominator, which is held.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyceres
import pycolmap
from jaxtyping import Float64

from splatpipe.pipeline.sfm.lenses.focal import solver_options
from splatpipe.pipeline.sfm.lenses.lens_blocks import hold, tie_focals
from splatpipe.pipeline.sfm.lenses.lens_model import NAMES, is_known, named_params

PRINCIPAL_POINT_SHARE = 0.01  # typical offset of a principal point from the image centre over the width
WEAK_SIGMA = {"k1": 0.2, "k2": 0.2, "k3": 0.2, "k4": 0.2, "p1": 0.01, "p2": 0.01}  # no camera lens has more
STATED_SHARE = 1e-3  # departure from a calibration at the corner, over the width: temperature, focus
STATED_FOCAL_SHARE = 3e-3
FREE = 1e6
ROBUST_PX = 1.0  # scale of the SOFT_L1 loss, as in the last adjustment of mapping
BASE = ("fx", "fy", "k1")


@dataclass(frozen=True)
class LensPrior:
    """Prior on the parameters of a lens.

    Attributes:
        mean: By parameter name of the wide model.
        sigmas: Standard deviations, likewise; missing parameters have no prior.
    """

    mean: Mapping[str, float]
    sigmas: Mapping[str, float]


def weak_prior(camera: pycolmap.Camera) -> LensPrior:
    """Return a prior that fits every lens: principal point near the image centre, distortion of a plausible size."""
    if not is_known(camera.model_name):
        return LensPrior({}, {})
    sigmas = {name: WEAK_SIGMA[name] for name in named_params(camera) if name in WEAK_SIGMA}
    centre = {"cx": camera.width / 2, "cy": camera.height / 2}
    share = PRINCIPAL_POINT_SHARE * camera.width
    return LensPrior({**dict.fromkeys(sigmas, 0.0), **centre}, {**sigmas, "cx": share, "cy": share})


def stated_prior(camera: pycolmap.Camera) -> LensPrior:
    """Return a prior around a calibrated lens: each parameter's sigma is set by its effect at the image corner.

    Args:
        camera: The stated lens, of a wide model.
    """
    named = named_params(camera)
    effects = corner_effects(camera)
    share = STATED_SHARE * camera.width
    sigmas = {name: share / max(float(np.abs(effect).max()), 1e-12) for name, effect in effects.items()}
    focal = STATED_FOCAL_SHARE * named["fx"]
    return LensPrior(named, {**sigmas, "fx": focal, "fy": focal, "cx": share, "cy": share})


def corner_effects(camera: pycolmap.Camera) -> dict[str, Float64[np.ndarray, "n 2"]]:
    """Return the displacement of the image corners, edge midpoints and centre per unit of each parameter, by name."""
    places = [[x, y] for x in (0.0, camera.width / 2, camera.width) for y in (0.0, camera.height / 2, camera.height)]
    rays = np.asarray(camera.cam_from_img(np.array(places)), np.float64)
    rays = np.concatenate([np.where(np.isfinite(rays), rays, 0.0), np.ones((len(rays), 1))], axis=1)
    names = NAMES[camera.model_name]
    result = {}
    for index, name in enumerate(names):
        moved = pycolmap.Camera(camera.todict())
        step = 1e-4 if index < 4 else 1e-7
        params = np.array(moved.params)
        params[index] += step
        moved.params = params
        difference = np.asarray(moved.img_from_cam(rays)) - np.asarray(camera.img_from_cam(rays))
        result[name] = np.where(np.isfinite(difference), difference, 0.0) / step
    return result


@dataclass(frozen=True)
class LensFreedom:
    """What an adjustment may change in a camera.

    Attributes:
        free: Names of the free parameters of the wide model; if empty, the lens is held.
        prior: Their prior.
    """

    free: tuple[str, ...]
    prior: LensPrior


@dataclass(frozen=True)
class LensAdjustment:
    """An adjusted model.

    Attributes:
        model: Its poses, lenses and points.
        covariances: Covariance of the free parameters of each lens, in the order of the wide model, by camera id, for
            a feature noise of one pixel; missing where the parameters are undetermined.
    """

    model: pycolmap.Reconstruction
    covariances: Mapping[int, Float64[np.ndarray, "_ _"]]


def adjust_lenses(
    model: pycolmap.Reconstruction, freedoms: Mapping[int, LensFreedom], with_covariances: bool = False
) -> LensAdjustment:
    """Adjust poses, points and free lens parameters in place, with equal feature weights and the gauge fixed.

    Args:
        model: A model whose cameras are of wide models.
        freedoms: By camera id.
        with_covariances: Also estimate covariances.
    """
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.loss_function_scale = ROBUST_PX
    config = pycolmap.BundleAdjustmentConfig()
    photos = sorted(model.reg_image_ids())
    for number in photos:
        config.add_image(number)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    ratios = {number: _ratio(camera) for number, camera in model.cameras.items() if "fx" in freedoms[number].free}
    kept = [free_lens(adjuster.problem, camera, freedoms[number]) for number, camera in sorted(model.cameras.items())]
    pyceres.solve(solver_options(len(photos)), adjuster.problem, pyceres.SolverSummary())
    covariances: dict[int, Float64[np.ndarray, "_ _"]] = {}
    if with_covariances:
        covariance = pycolmap.estimate_ba_covariance_from_problem(_all_covariances(), model, adjuster.problem)
        for number, camera in sorted(model.cameras.items()):
            block = None if covariance is None else covariance.get_other_params_cov(camera.params)
            if block is not None and np.isfinite(block).all():
                covariances[number] = np.asarray(block)
    del kept
    for number, ratio in ratios.items():
        params = np.array(model.cameras[number].params)
        params[1] = params[0] * ratio  # to the last bit
        model.cameras[number].params = params
    return LensAdjustment(model, covariances)


def _ratio(camera: pycolmap.Camera) -> float:
    return float(camera.params[1] / camera.params[0])


def _all_covariances() -> pycolmap.BACovarianceOptions:
    options = pycolmap.BACovarianceOptions()
    options.params = pycolmap.BACovarianceOptionsParams.ALL
    return options


def free_lens(problem: Any, camera: pycolmap.Camera, freedom: LensFreedom) -> list[object]:
    """Free some parameters of a camera in a problem, and hold the others.

    Args:
        problem: A pyceres problem as COLMAP builds it.
        camera: The problem's own camera, of a wide model.
        freedom: What may change.

    Returns:
        Objects that must be kept alive until the problem is solved.
    """
    params = camera.params
    if not problem.has_parameter_block(params):
        return []
    if not is_known(camera.model_name):
        return hold(problem, camera, list(range(len(params))))
    names = NAMES[camera.model_name]
    held = [index for index, name in enumerate(names) if name not in freedom.free]
    if len(held) == len(names):
        return hold(problem, camera, held)
    kept = hold(problem, camera, held)
    mean = np.array([freedom.prior.mean.get(name, value) for name, value in zip(names, params, strict=True)])
    sigmas = np.array([freedom.prior.sigmas.get(name, FREE) for name in names])
    prior = pyceres.factors.NormalPrior(mean, np.diag(sigmas**2))
    problem.add_residual_block(prior, None, [params])
    kept.append(prior)
    return kept + tie_focals(problem, camera) if "fx" in freedom.free else kept


def corner_sigma_px(
    camera: pycolmap.Camera, names: Iterable[str], covariance: Float64[np.ndarray, "k k"], free: Iterable[str]
) -> float:
    """Propagate the covariance of some parameters to the image corners.

    Args:
        camera: A camera of a wide model.
        names: The parameters to propagate.
        covariance: Covariance of all free parameters, in the model's order.
        free: Names of the free parameters.

    Returns:
        The largest standard deviation at a corner or edge midpoint, pixels.
    """
    order = [name for name in NAMES[camera.model_name] if name in set(free)]
    rows = [order.index(name) for name in names]
    part = covariance[np.ix_(rows, rows)]
    effects = corner_effects(camera)
    design = np.stack([effects[name] for name in names], axis=2)  # corner, axis, parameter
    spread = np.einsum("cap,pq,caq->c", design, part, design)
    return math.sqrt(max(float(spread.max()), 0.0))
