"""Parts of a visit to a GPU: other trainers' rasterizers on the same Gaussians, views and photos, with the same loss.

gsplat 1.5.3 as its own trainer calls it (``packed=False``, SelectiveAdam) and Faster-GS with its FusedAdam; both with
fused-ssim, if it was carried and compiles, and otherwise with SSIM by torch's convolutions, which the row states.
"""

from __future__ import annotations

import importlib
import json
import os
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from itertools import cycle
from pathlib import Path
from typing import Any, Protocol

import gpu_scenes
import torch
from gpu_parts import Row
from gpu_peer_sources import DESCRIPTION
from gpu_proofs import SSIM_WEIGHT
from gpu_scenes import MEGAPIXELS
from gpu_speed import REPEATS, WARMUP, event_times, forget_peak, peak_gb
from torch import Tensor
from torch.nn.functional import conv2d

from splatpipe.pipeline.geometry.camera import Camera

WINDOW, SIGMA = 11, 1.5  # SSIM's window in pixels and its Gaussian's deviation, as published
C1, C2 = 0.01**2, 0.03**2
BETAS, EPSILON = (0.9, 0.999), 1e-15
RATES = {"means": 1.6e-5, "log_scales": 5e-3, "quats": 1e-3, "opacity_logits": 5e-2, "sh": 2.5e-3}
SH_DEGREE = 3
NEAR, FAR = 0.01, 1e10  # near as in our render options
PEERS = Path(tempfile.gettempdir()) / "splatpipe-gpu-visit" / "peers"  # packages, each with its compiled module


class Peer(Protocol):
    """Another trainer: its model, rasterizer and optimiser."""

    optimiser: str

    def render(self, camera: Camera) -> Tensor:
        """Return the image, (3, h, w)."""
        ...

    def step(self) -> None:
        """Step the parameters with the gradients of the last image, and clear these."""
        ...

    def forget(self) -> None:
        """Clear the gradients."""
        ...


def compiled(peer: str) -> Iterator[Row]:
    """Compile a peer that was carried.

    Raises:
        SystemExit: if it was not, or does not compile.
    """
    source = gpu_scenes.PACK / "peers" / peer
    if not (source / DESCRIPTION).exists():
        raise SystemExit(f"{peer} was not carried")
    build = json.loads((source / DESCRIPTION).read_text())
    from torch.utils import cpp_extension

    began = time.monotonic()
    scratch = PEERS.parent / "compiled" / peer
    scratch.mkdir(parents=True, exist_ok=True)
    os.environ.setdefault("TORCH_CUDA_ARCH_LIST", "9.0")
    module = cpp_extension.load(
        build["extension"],
        [str(source / path) for path in build["sources"]],
        extra_cflags=build["cxx"],
        extra_cuda_cflags=build["nvcc"],
        extra_ldflags=build["linker"],
        extra_include_paths=[str(source / path) for path in build["includes"]],
        build_directory=str(scratch),
        with_cuda=True,
    )
    for package in build["packages"]:
        shutil.copytree(source / package, PEERS / package, dirs_exist_ok=True)
    shutil.copy2(module.__file__, PEERS / build["beside"])  # last: who finds it finds everything
    yield {"peer": peer, "version": build["version"], "seconds": round(time.monotonic() - began, 1)}


def speed(peer: str, count: int | None, megapixels: float = MEGAPIXELS, repeats: int = REPEATS) -> Iterator[Row]:
    """Time whole iterations and the rasterizer alone, as ``gpu_speed.speed`` does for ours.

    Raises:
        SystemExit: if the peer was not compiled.
    """
    description = gpu_scenes.PACK / "peers" / peer / DESCRIPTION
    build = json.loads(description.read_text()) if description.exists() else None
    if build is None or not (PEERS / build["beside"] / f"{build['extension']}.so").exists():
        raise SystemExit(f"{peer} was not compiled")
    sys.path.insert(0, str(PEERS))
    where = torch.device("cuda", torch.cuda.current_device())
    made: Peer = {"gsplat": Gsplat, "faster-gs": FasterGs}[peer](count, where)
    ssim, name = _ssim()
    eight_bits = [  # on the device, as ours
        (camera, (255.0 * photo).round().to(torch.uint8).permute(2, 0, 1).contiguous().to(where))
        for camera, photo in gpu_scenes.photos(megapixels)
    ]
    views = cycle(eight_bits)

    def iteration() -> None:
        camera, bits = next(views)
        photo = bits.float() / 255.0
        picture = made.render(camera)
        loss = (1 - SSIM_WEIGHT) * (picture - photo).abs().mean()
        loss = loss + SSIM_WEIGHT * (1 - ssim(picture[None], photo[None]))
        loss.backward()  # type: ignore[no-untyped-call]
        made.step()

    def alone() -> None:
        made.forget()
        picture = made.render(next(views)[0])
        picture.backward(upstream[: picture.shape[0], : picture.shape[1], : picture.shape[2]])

    upstream = torch.randn_like(made.render(next(views)[0]))
    row: Row = {"peer": peer, "version": build["version"], "scene": "trained" if count is None else "made"}
    row |= {"count": len(gpu_scenes.gaussians(count, torch.device("cpu"))) if count is None else count}
    row |= {"megapixels": megapixels, "sh_degree": SH_DEGREE, "ssim": name, "optimiser": made.optimiser}
    for function, heading, peak in ((iteration, "iteration_ms", "peak_gb"), (alone, "raster_ms", "raster_peak_gb")):
        event_times(function, WARMUP, where)
        forget_peak(where)
        row[heading] = 1e3 * statistics.median(event_times(function, repeats, where))
        row[peak] = peak_gb(where)
        yield row | {"repeats": repeats}


class Gsplat:
    """gsplat.

    Args:
        count: As for ``gpu_scenes.gaussians``.
        where: The device.
    """

    optimiser = "SelectiveAdam"

    def __init__(self, count: int | None, where: torch.device) -> None:
        self._rasterization = importlib.import_module("gsplat").rasterization
        self._given = _parameters(count, where)
        adam = importlib.import_module("gsplat.optimizers").SelectiveAdam
        groups = [{"params": [self._given[name]], "lr": rate} for name, rate in RATES.items()]
        self._optimisers = [adam([group], eps=EPSILON, betas=BETAS) for group in groups]
        self._seen = torch.ones(0)

    def render(self, camera: Camera) -> Tensor:
        given = self._given
        pose, matrix = _pose(camera, given["means"].device)
        picture, _, facts = self._rasterization(
            given["means"],
            given["quats"],
            given["log_scales"].exp(),
            given["opacity_logits"].sigmoid(),
            given["sh"],
            pose[None],
            matrix[None],
            camera.width,
            camera.height,
            near_plane=NEAR,
            sh_degree=SH_DEGREE,
            packed=False,
        )
        self._seen = (facts["radii"] > 0).all(-1).any(0)
        return picture[0].permute(2, 0, 1)  # type: ignore[no-any-return]

    def step(self) -> None:
        for optimiser in self._optimisers:
            optimiser.step(self._seen)
            optimiser.zero_grad(set_to_none=True)

    def forget(self) -> None:
        _forget(self._given)


class FasterGs:
    """Faster-GS; arguments as for ``Gsplat``."""

    optimiser = "FusedAdam"

    def __init__(self, count: int | None, where: torch.device) -> None:
        self._backend = importlib.import_module("FasterGSCudaBackend.torch_bindings.rasterization")
        given = {name: tensor.detach() for name, tensor in _parameters(count, where).items()}
        sh, logits = given.pop("sh"), given.pop("opacity_logits")
        given |= {"opacity_logits": logits[:, None], "sh": sh[:, :1], "sh_rest": sh[:, 1:]}
        self._given = {name: tensor.contiguous().requires_grad_() for name, tensor in given.items()}
        adam = importlib.import_module("FasterGSCudaBackend.torch_bindings.adam").FusedAdam
        rates = RATES | {"sh_rest": RATES["sh"] / 20}
        groups = [{"params": [tensor], "lr": rates[name]} for name, tensor in self._given.items()]
        self._optimiser = adam(groups, lr=0.0, eps=EPSILON)

    def render(self, camera: Camera) -> Tensor:
        given, where = self._given, self._given["means"].device
        pose, _ = _pose(camera, where)
        position = -(pose[:3, :3].T @ pose[:3, 3])
        settings = self._backend.RasterizerSettings(
            *(pose, position.contiguous(), torch.zeros(3, device=where), (SH_DEGREE + 1) ** 2),
            *(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy),
            *(NEAR, FAR, False),
        )
        picture: Tensor = self._backend.diff_rasterize(
            *(given["means"], given["log_scales"], given["quats"], given["opacity_logits"]),
            *(given["sh"], given["sh_rest"], torch.empty(0), settings),
        )
        return picture

    def step(self) -> None:
        self._optimiser.step()
        self._optimiser.zero_grad(set_to_none=True)

    def forget(self) -> None:
        _forget(self._given)


def _parameters(count: int | None, where: torch.device) -> dict[str, Tensor]:
    model = gpu_scenes.gaussians(count, where)
    return {name: tensor.requires_grad_() for name, tensor in model.tensors().items()}


def _forget(tensors: dict[str, Tensor]) -> None:
    for tensor in tensors.values():
        tensor.grad = None


def _pose(camera: Camera, where: torch.device) -> tuple[Tensor, Tensor]:
    """Return a camera's pose, (4, 4), and intrinsics, (3, 3)."""
    pose = torch.eye(4)
    pose[:3] = torch.as_tensor(camera.cam_from_world[:3], dtype=torch.float32)
    matrix = torch.tensor([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    return pose.to(where), matrix.to(where)


def _ssim() -> tuple[Callable[[Tensor, Tensor], Tensor], str]:
    try:
        fused: Any = importlib.import_module("fused_ssim").fused_ssim
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
