"""Measure the rasterizer alone, as used in training: its speed and the pairs that it blends."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.native import _native
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.train.iteration import render_options
from splatpipe.pipeline.train.plan.plan import TrainingPlan
from splatpipe.pipeline.train.state.state import TrainState

WARMUP = 3  # renders that are not measured


def raster_alone(state: TrainState, plan: TrainingPlan, cameras: Sequence[Camera]) -> dict[str, Any]:
    """Time the rasterizer's forward and backward pass in sequence, without the rest of training.

    Args:
        state: Provides the Gaussians, which stay unchanged.
        plan: The training's plan.
        cameras: Cameras to render, in turn.

    Returns:
        Median wall seconds per view, and pairs per second and core (CPU seconds of all threads, over all views).
    """
    options = replace(render_options(plan, plan.schedule.at(max(1, state.iteration))), magnitudes=False)
    pairs, wall, cpu = 0, [], 0.0
    for index, camera in enumerate([*cameras[:WARMUP], *cameras]):
        generator = torch.Generator().manual_seed(index)
        upstream = torch.randn(camera.height, camera.width, 3, generator=generator) / (camera.width * camera.height)
        began, began_cpu = time.perf_counter(), time.process_time()
        rendered = rasterizer.render(state.gaussians, camera, options)
        rendered.colour.backward(upstream)  # type: ignore[no-untyped-call]
        took, took_cpu = time.perf_counter() - began, time.process_time() - began_cpu
        for tensor in state.gaussians.tensors().values():
            tensor.grad = None
        if index < WARMUP:
            continue
        wall.append(took)
        cpu += took_cpu
        pairs += contributing_pairs(state.gaussians, camera, plan, state.iteration)
    return {"alone_wall_s": statistics.median(wall), "alone_gpairs_per_s_per_core": 1e-9 * pairs / cpu}


def contributing_pairs(gaussians: Gaussians, camera: Camera, plan: TrainingPlan, iteration: int) -> int:
    """Count the pixel-Gaussian pairs blended by a training iteration's render: alpha ≥ 1/255, before a pixel saturates.

    Args:
        gaussians: The Gaussians before the iteration.
        camera: The iteration's camera.
        plan: The training's plan.
        iteration: Iteration, from 1.
    """
    now = plan.schedule.at(iteration)
    n, h, w = len(gaussians), camera.height, camera.width
    frame = _native.Frame()
    frame.forward(
        tuple(tensor.detach().contiguous() for tensor in gaussians.tensors().values()),
        (np.ascontiguousarray(camera.cam_from_world, np.float64), (w, h), (camera.fx, camera.fy, camera.cx, camera.cy)),
        (now.sh_degree, plan.options.antialias, plan.near, 0.0, now.background),
        (torch.empty(h, w, 3), torch.empty(h, w), None, torch.empty(n), torch.empty(n, dtype=torch.uint8)),
    )
    return int(frame.contributing_pairs())
