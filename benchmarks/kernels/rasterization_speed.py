"""Time ``rasterization`` beside the line's own render, forward and backward: ``python benchmarks rasterization_speed``.

Both render the same Gaussians of one view and differentiate a squared error. Times are of all threads together (CPU
time), so that a busy machine shifts both alike.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster.definitions import RenderOptions
from splatpipe.pipeline.raster.isa import _native
from splatpipe.pipeline.raster.rasterization import rasterization
from splatpipe.pipeline.raster.rasterizer import render
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.sh import C0

FOCAL = 500.0


def random_gaussians(count: int, sh_count: int, aspect: float) -> Gaussians:
    """Gaussians of a few pixels, all over the view."""
    generator = torch.Generator().manual_seed(1)
    z = 2.0 + 8.0 * torch.rand(count, 1, generator=generator)
    across = (torch.rand(count, 2, generator=generator) - 0.5) * torch.tensor([1.3, 1.3 / aspect]) * z
    return Gaussians(
        torch.cat([across, z], 1),
        0.4 * torch.randn(count, 3, generator=generator) - 3.5,
        torch.randn(count, 4, generator=generator),
        1.5 * torch.randn(count, generator=generator),
        0.2 * torch.randn(count, sh_count, 3, generator=generator),
    )


def of_the_line(model: Gaussians, camera: Camera, truth: Tensor) -> Callable[[], None]:
    leaves = model.clone().requires_grad_()

    def work() -> None:
        for tensor in leaves.tensors().values():
            tensor.grad = None
        shown = render(leaves, camera, RenderOptions(leaves.sh_degree, depth=False)).colour
        (shown - truth).square().sum().backward()

    return work


def of_rasterization(model: Gaussians, camera: Camera, truth: Tensor, sh_degree: int | None) -> Callable[[], None]:
    colors = model.sh if sh_degree is not None else (0.5 + C0 * model.sh[:, 0]).clamp_min(0.0)
    activated = (model.means, model.quats, torch.exp(model.log_scales), torch.sigmoid(model.opacity_logits), colors)
    leaves = [tensor.detach().clone().requires_grad_() for tensor in activated]
    views = (torch.from_numpy(camera.cam_from_world)[None], torch.from_numpy(camera.k())[None])

    def work() -> None:
        for leaf in leaves:
            leaf.grad = None
        shown, _, _ = rasterization(*leaves, *views, camera.width, camera.height, sh_degree=sh_degree)
        (shown[0] - truth).square().sum().backward()

    return work


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--gaussians", type=int, default=100_000)
    parser.add_argument("--repeats", type=int, default=15)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    _native.set_threads(arguments.threads)
    width, height = arguments.size
    camera = Camera("view", width, height, FOCAL, FOCAL, width / 2, height / 2, np.eye(4))
    truth = torch.rand(height, width, 3)
    print(f"{arguments.gaussians} Gaussians, {width} x {height}, {arguments.threads} threads, ms of CPU time:")
    for name, sh_degree in (("RGB", None), ("SH of degree 3", 3)):
        model = random_gaussians(arguments.gaussians, 1 if sh_degree is None else 16, width / height)
        works = (of_the_line(model, camera, truth), of_rasterization(model, camera, truth, sh_degree))
        times: tuple[list[float], list[float]] = ([], [])
        for _ in range(arguments.repeats):
            for work, taken in zip(works, times, strict=True):  # in turn
                begun = time.process_time()
                work()
                taken.append(1e3 * (time.process_time() - begun))
        line, ours = (statistics.median(taken[2:]) for taken in times)
        print(f"  {name:<15} line {line:7.1f}   rasterization {ours:7.1f}   ratio {ours / line:.2f}")


if __name__ == "__main__":
    main()
