"""Cases of features, and their outcome by the float64 definition."""

from __future__ import annotations

import numpy as np
import torch
from feature_frames import GAUSSIANS, FeatureCase, FeatureOutcome
from random_scene import random_camera
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster.feature_definitions import BlendOptions, ProjectionOptions, View
from splatpipe.pipeline.raster.feature_reference import REFERENCE


def feature_case(seed: int, count: int, channels: int, size: tuple[int, int], **settings: object) -> FeatureCase:
    """Return random Gaussians before a turned camera: some out of view, two opaque, two not there at all."""
    rng = np.random.default_rng(seed)
    camera = random_camera(seed, *size)
    opacities = rng.random(count)
    opacities[:2], opacities[2:4] = 1.0, 0.0
    rows = {
        "means": rng.normal(size=(count, 3)) * [1.5, 1.2, 1.5] + [0.0, 0.0, 4.0],
        "quats": rng.normal(size=(count, 4)) * rng.uniform(0.1, 10.0, (count, 1)),
        "scales": np.exp(rng.normal(size=(count, 3)) * 0.5 - 1.8) * rng.choice([-1.0, 1.0], (count, 3)),
        "opacities": opacities,
    }
    if "sh_degree" in settings:
        rows["sh"] = 0.4 * rng.normal(size=(count, 16, 3))
    else:
        rows["features"] = rng.normal(size=(count, channels))  # of either sign
    case = FeatureCase(
        {name: values.astype(np.float32) for name, values in rows.items()},
        camera.cam_from_world[:3].copy(),
        (camera.fx, camera.fy, camera.cx, camera.cy),
        size,
        background=rng.normal(size=channels).astype(np.float32),
    ).changed(**settings)
    width, height = size
    upstream = {"features": rng.normal(size=(height, width, case.channels)), "alpha": rng.normal(size=(height, width))}
    return case.changed(upstream={name: value.astype(np.float32) for name, value in upstream.items()})


def view_of(case: FeatureCase) -> View:
    pose = np.eye(4)
    pose[:3] = case.pose
    return View(Camera("view", *case.size, *case.intrinsics, pose), np.linalg.inv(pose)[:3, 3])


def exact_features(case: FeatureCase) -> FeatureOutcome:
    """Return the outcome by the definition."""
    leaves = {name: torch.from_numpy(rows).double().requires_grad_() for name, rows in case.rows.items()}
    view, (far, blur, sigmas, floor, clip) = [view_of(case)], case.options
    how = ProjectionOptions(case.near, far, blur, sigmas, case.compensate, floor, clip, case.slanted)
    means, quats, scales, opacities = (leaves[name][None] for name in GAUSSIANS)
    splats = REFERENCE.project(view, how, means, quats, scales, opacities)
    if splats.compensations is not None:
        opacities = opacities * splats.compensations
    features = leaves["features"][None] if "features" in leaves else colours_of(case, leaves, view, splats.radii)
    behind = None if case.background is None else torch.from_numpy(case.background).double()[None]
    if case.depth:
        features = torch.cat([features, splats.depths[..., None]], -1)
        behind = None if behind is None else torch.cat([behind, behind.new_zeros(1, 1)], -1)
    magnitudes = torch.zeros(1, case.count, 2, dtype=torch.float64) if case.magnitudes else None
    blending = BlendOptions(*case.size, case.alpha_max)
    shown, alpha = REFERENCE.blend(blending, splats, opacities, features, behind, magnitudes)
    pictures = {"features": shown[0], "alpha": alpha[0]}
    total = sum((pictures[name] * torch.from_numpy(weight).double()).sum() for name, weight in case.upstream.items())
    found = torch.autograd.grad(total, list(leaves.values()), allow_unused=True, materialize_grads=True)
    gradients = {name: each.numpy() for name, each in zip(leaves, found, strict=True)}
    if magnitudes is not None:
        gradients["magnitudes"] = magnitudes[0].numpy()
    images = {name: picture.detach().numpy() for name, picture in pictures.items()}
    return FeatureOutcome(images | {"radii": splats.radii[0].numpy()}, gradients)


def colours_of(case: FeatureCase, leaves: dict[str, Tensor], views: list[View], radii: Tensor) -> Tensor:
    return REFERENCE.sh_colours(views, case.sh_degree, leaves["means"][None], leaves["sh"][None], radii)
