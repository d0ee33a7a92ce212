"""Parts of ``gpu_day.py measure``: gsplat on the same Gaussians and cameras, if it compiles.

gsplat 1.5.3 as its own trainer calls it: ``packed=False``, SelectiveAdam, and fused-ssim if it was carried and
compiles; otherwise SSIM by torch's convolutions, which the row states.
"""

from __future__ import annotations

import importlib
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from itertools import cycle
from pathlib import Path
from typing import Any

import gpu_scenes
import torch
from gpu_parts import Row
from gpu_speed import CAPTURE, MEGAPIXELS, REPEATS, WARMUP, event_times, forget_peak, peak_gb
from torch import Tensor
from torch.nn.functional import conv2d

SSIM_WEIGHT = 0.2
WINDOW, SIGMA = 11, 1.5  # of SSIM, as published
C1, C2 = 0.01**2, 0.03**2
BETAS, EPSILON = (0.9, 0.999), 1e-15
RATES = {"means": 1.6e-5, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh": 2.5e-3}
TARGET = Path(tempfile.gettempdir()) / "splatpipe-gpu-day" / "peers"


def compiled() -> Iterator[Row]:
    """Compile what was carried: gsplat compiles itself on first use.

    Raises:
        SystemExit: if gsplat does not compile.
    """
    yield {"fused_ssim": _install(gpu_scenes.PACK / "peers" / "fused-ssim")}
    try:
        backend = importlib.import_module("gsplat.cuda._backend")
    except ImportError as error:
        raise SystemExit(f"gsplat was not carried: {error}") from error
    yield {"gsplat": importlib.import_module("gsplat").__version__, "compiled": backend._C is not None}
    if backend._C is None:
        raise SystemExit("gsplat does not compile here")


def _install(source: Path) -> str:
    if not source.is_dir():
        return "not carried"
    words = ["install", "-q", "--no-deps", "--no-build-isolation", "--no-index", "--target", str(TARGET), str(source)]
    done = subprocess.run([sys.executable, "-m", "pip", *words], capture_output=True, text=True, check=False)
    return "compiled" if done.returncode == 0 else done.stderr.strip()[-300:]


def speed(count: int, megapixels: float = MEGAPIXELS) -> Iterator[Row]:
    """Time whole iterations and the rasterizer alone, as ``gpu_speed.speed`` does for ours."""
    where = torch.device("cuda")
    rasterization = importlib.import_module("gsplat").rasterization
    given = _parameters(count, where)
    views = cycle(_views(megapixels, where))
    ssim, name = _ssim()
    optimisers = _optimisers(given)

    def render() -> tuple[Tensor, dict[str, Any]]:
        pose, matrix, size = next(views)
        picture, _, facts = rasterization(
            given["means"],
            given["quats"],
            given["scales"].exp(),
            given["opacities"].sigmoid(),
            given["sh"],
            pose,
            matrix,
            *size,
            sh_degree=3,
            packed=False,
        )
        return picture, facts

    def iteration() -> None:
        picture, facts = render()
        loss = (1 - SSIM_WEIGHT) * (picture - photo).abs().mean()
        loss = loss + SSIM_WEIGHT * (1 - ssim(picture.permute(0, 3, 1, 2), photo.permute(0, 3, 1, 2)))
        loss.backward()  # type: ignore[no-untyped-call]
        seen = (facts["radii"] > 0).all(-1).any(0)
        for optimiser in optimisers:
            optimiser.step(seen)
            optimiser.zero_grad(set_to_none=True)

    def alone() -> None:
        for tensor in given.values():
            tensor.grad = None
        picture, _ = render()
        picture.backward(upstream)

    photo = torch.rand_like(render()[0])
    upstream = torch.randn_like(photo)
    row: Row = {"peer": "gsplat 1.5.3", "count": count, "megapixels": megapixels, "ssim": name}
    for function, heading, memory in ((iteration, "iteration_ms", "peak_gb"), (alone, "raster_ms", "raster_peak_gb")):
        event_times(function, WARMUP, where)
        forget_peak(where)
        row[heading] = 1e3 * statistics.median(event_times(function, REPEATS, where))
        row[memory] = peak_gb(where)
    yield row


def _parameters(count: int, where: torch.device) -> dict[str, Tensor]:
    ours = gpu_scenes.gaussians(CAPTURE, count, where)
    tensors = (ours.means, ours.log_scales, ours.quats, ours.opacity_logits, ours.sh)
    return {name: tensor.requires_grad_() for name, tensor in zip(RATES, tensors, strict=True)}


def _optimisers(given: dict[str, Tensor]) -> list[Any]:
    adam = importlib.import_module("gsplat.optimizers").SelectiveAdam
    return [adam([{"params": [given[name]], "lr": rate}], eps=EPSILON, betas=BETAS) for name, rate in RATES.items()]


def _views(megapixels: float, where: torch.device) -> list[tuple[Tensor, Tensor, tuple[int, int]]]:
    found = []
    for camera in gpu_scenes.cameras(CAPTURE, megapixels):
        pose = torch.eye(4)
        pose[:3] = torch.as_tensor(camera.cam_from_world[:3], dtype=torch.float32)
        matrix = torch.tensor([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
        size = (camera.width, camera.height)
        found.append((pose[None].to(where), matrix[None].to(where), size))
    return found


def _ssim() -> tuple[Callable[[Tensor, Tensor], Tensor], str]:
    try:
        fused = importlib.import_module("fused_ssim").fused_ssim
    except (ImportError, OSError):
        return torch_ssim, "by torch"
    return lambda a, b: fused(a, b, padding="same"), "fused-ssim"


def torch_ssim(a: Tensor, b: Tensor) -> Tensor:
    """Return the mean SSIM of (1, 3, h, w) images, by separable convolutions."""
    places = torch.arange(WINDOW, device=a.device) - WINDOW // 2
    weights = torch.exp(-(places**2) / (2 * SIGMA**2))
    weights = (weights / weights.sum()).repeat(3, 1, 1, 1)

    def blurred(picture: Tensor) -> Tensor:
        across = conv2d(picture, weights, padding=(0, WINDOW // 2), groups=3)
        return conv2d(across, weights.transpose(2, 3), padding=(WINDOW // 2, 0), groups=3)

    mean_a, mean_b = blurred(a), blurred(b)
    var_a, var_b = blurred(a * a) - mean_a**2, blurred(b * b) - mean_b**2
    covariance = blurred(a * b) - mean_a * mean_b
    likeness = (2 * mean_a * mean_b + C1) * (2 * covariance + C2)
    return (likeness / ((mean_a**2 + mean_b**2 + C1) * (var_a + var_b + C2))).mean()
