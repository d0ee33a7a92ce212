"""Frames by the float64 definition, and by the CPU's own kernels."""

from __future__ import annotations

import math

import numpy as np
import torch
from frames import GREY, PARAMETERS, RenderCase, RenderOutcome

from splatpipe.pipeline.geometry.camera import Camera, Window
from splatpipe.pipeline.raster.rasterizer import RenderOptions, render
from splatpipe.pipeline.splat.model.gaussians import Gaussians


def case_of(scene: Gaussians, camera: Camera, seed: int = 5, **settings: object) -> RenderCase:
    """Return the case of a scene, with random upstream gradients for all images."""
    rng = np.random.default_rng(seed)
    size, part = (camera.height, camera.width), camera.window
    upstream = {"colour": rng.normal(size=(*size, 3)), **{name: rng.normal(size=size) for name in GREY}}
    return RenderCase(
        {name: getattr(scene, name).detach().numpy() for name in PARAMETERS},
        camera.cam_from_world[:3].copy(),
        (camera.fx, camera.fy, camera.cx, camera.cy),
        (camera.width, camera.height),
        {name: value.astype(np.float32) for name, value in upstream.items()},
        window=part and (part.left, part.top, part.whole_width, part.whole_height),
        sh_degree=math.isqrt(scene.sh.shape[1]) - 1,
    ).changed(**settings)


def camera_of(case: RenderCase) -> Camera:
    pose = np.eye(4)
    pose[:3] = case.pose
    return Camera("view", *case.size, *case.intrinsics, pose, None if case.window is None else Window(*case.window))


def options_of(case: RenderCase) -> RenderOptions:
    return RenderOptions(
        case.sh_degree,
        background=case.background,
        antialias=case.antialias,
        near=case.near,
        depth=case.depths,
        depth_origin=case.depth_origin,
        magnitudes=case.magnitudes,
    )


def exact_outcome(case: RenderCase, backend: str = "reference", gradients: bool = True) -> RenderOutcome:
    """Return the outcome by the definition in float64, or by the CPU's kernels in float32."""
    dtype = torch.float64 if backend == "reference" else torch.float32
    leaves = {name: torch.from_numpy(case.rows[name]).to(dtype).requires_grad_(gradients) for name in PARAMETERS}
    probe = torch.zeros(case.count, 2, dtype=dtype, requires_grad=gradients)
    scene = Gaussians(**leaves)
    made = render(scene, camera_of(case), options_of(case), backend=backend, means2d_probe=probe)  # type: ignore[arg-type]
    names = ("colour", *GREY, "median_depth") if case.depths else ("colour", "alpha")
    pictures = {name: getattr(made, name).detach().numpy() for name in (*names, "radii")}
    pictures["visible"] = made.visible.numpy().astype(np.uint8)
    back = {}
    if gradients and case.upstream:
        total = torch.zeros((), dtype=dtype)
        for name, weights in case.upstream.items():
            if name in names:
                total = total + (getattr(made, name) * torch.from_numpy(weights).to(dtype)).sum()
        asked = leaves | {"means2d": probe}
        back = dict(zip(asked, torch.autograd.grad(total, list(asked.values())), strict=True))
    return RenderOutcome(pictures, {name: value.numpy() for name, value in back.items()})
