"""How long a render and its gradient take: ``python benchmarks/raster_speed.py --data DATASET``.

DATASET holds `sparse/0` with PINHOLE cameras; its points become Gaussians as the line's `initialize` makes them.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
import torch

from splatpipe.pipeline.raster import RenderOptions, _native, render, set_threads
from splatpipe.pipeline.scene.camera import Camera
from splatpipe.pipeline.scene.dataset import load_points, load_views
from splatpipe.pipeline.scene.gaussians import Gaussians
from splatpipe.stages.initialize import make_gaussians, point_sizes

OPACITY = 0.1
MAX_ANGLE = 0.1


def load(data: Path) -> tuple[Gaussians, list[Camera]]:
    """The Gaussians at the points of a dataset, and its cameras."""
    points = load_points(data)
    cameras = [view.camera for view in load_views(data)]
    centres = np.array([camera.centre() for camera in cameras])
    sizes = point_sizes(points.xyz, centres, MAX_ANGLE)
    return make_gaussians(points.xyz, points.rgb, sizes, OPACITY), cameras


def measure(
    gaussians: Gaussians, camera: Camera, options: RenderOptions, repeats: int, depth: bool
) -> dict[str, float]:
    """Shortest and median times of a view's forward and backward pass, ms."""
    gaussians = gaussians.detach().clone().requires_grad_()
    probe = torch.zeros(len(gaussians), 2, requires_grad=True)
    colour_gradient = torch.randn(camera.height, camera.width, 3) / (camera.height * camera.width)
    depth_gradient = colour_gradient[..., 0].contiguous()
    forward, backward = [], []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        result = render(gaussians, camera, options, backend="native", means2d_probe=probe)
        middle = time.perf_counter()
        outputs, gradients = [result.colour], [colour_gradient]
        if depth:
            outputs.append(result.depth_sum)
            gradients.append(depth_gradient)
        torch.autograd.grad(outputs, [*gaussians.tensors().values(), probe], gradients)
        backward.append(1e3 * (time.perf_counter() - middle))
        forward.append(1e3 * (middle - start))
    forward, backward = forward[1:], backward[1:]  # the first one faults its memory in
    return {
        "forward_ms": min(forward),
        "backward_ms": min(backward),
        "forward_median_ms": float(np.median(forward)),
        "backward_median_ms": float(np.median(backward)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="a folder with sparse/0")
    parser.add_argument("--megapixels", type=float, nargs="+", default=[0.1, 0.4, 1.6])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--isa", nargs="+", default=["auto"], help="auto, avx512, avx2, baseline")
    parser.add_argument("--view", type=int, default=0, help="which view, in name order")
    parser.add_argument("--sh-degree", type=int, default=3)
    parser.add_argument("--depth", action="store_true", help="with depths and a gradient of theirs")
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--json", action="store_true", help="one JSON object and nothing else")
    arguments = parser.parse_args()
    torch.manual_seed(0)
    gaussians, cameras = load(arguments.data)
    rows = []
    for isa in arguments.isa:
        _native.set_isa(isa)
        for megapixels in arguments.megapixels:
            full = cameras[arguments.view]
            factor = (1e6 * megapixels / (full.width * full.height)) ** 0.5
            camera = full.scaled(round(full.width * factor), round(full.height * factor))
            for threads in arguments.threads:
                set_threads(threads)
                times = measure(
                    gaussians,
                    camera,
                    RenderOptions(arguments.sh_degree, depth=arguments.depth),
                    arguments.repeats,
                    arguments.depth,
                )
                row = {"isa": _native.isa(), "width": camera.width, "height": camera.height, "threads": threads} | times
                rows.append(row)
                if not arguments.json:
                    print(
                        f"{row['isa']:<9}{camera.width:>5} x {camera.height:<5}{threads} threads"
                        f"  forward {times['forward_ms']:8.2f} ms  backward {times['backward_ms']:8.2f} ms"
                        f"  (medians {times['forward_median_ms']:.2f}, {times['backward_median_ms']:.2f})"
                    )
    if arguments.json:
        print(json.dumps({"gaussians": len(gaussians), "sh_degree": arguments.sh_degree, "runs": rows}))


if __name__ == "__main__":
    main()
