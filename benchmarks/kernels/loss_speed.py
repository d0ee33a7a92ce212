"""Time the photometric loss and an Adam step, ours and the libraries': ``python benchmarks loss_speed``."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial

import torch

from splatpipe.pipeline.native import _native
from splatpipe.pipeline.raster.loss import photo_loss, photo_loss_reference
from splatpipe.pipeline.raster.optim import Adam, sh_rates

SHAPES = {"means": (3,), "log_scales": (3,), "quats": (4,), "opacity_logits": (), "sh": (16, 3)}
"""The 59 floats of a Gaussian of degree 3."""


def best_ms(work: Callable[[], object], repeats: int) -> float:
    """Return the shortest of several runs, the first excluded: what an undisturbed machine can do."""
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return 1e3 * min(times)


def measure_loss(height: int, width: int, repeats: int) -> None:
    photo = torch.rand(height, width, 3)
    render = (photo + 0.1 * torch.randn_like(photo)).clamp(0, 1).requires_grad_()
    mask = torch.ones(height, width, dtype=torch.bool)
    mask[: height // 4, : width // 2] = False

    def run(function: Callable[..., torch.Tensor], *args: object) -> None:
        render.grad = None
        function(render, photo, 0.2, *args).backward()

    print(f"loss and gradient, {width} x {height}, RGB:")
    print(f"  kornia            {best_ms(lambda: run(photo_loss_reference), max(2, repeats // 5)):9.2f} ms")
    for isa in _native.isas():
        _native.set_isa(isa)
        print(f"  native {isa:<10} {best_ms(lambda: run(photo_loss), repeats):9.2f} ms", end="")
        print(f"   masked {best_ms(lambda: run(photo_loss, mask), repeats):9.2f} ms")
    _native.set_isa("auto")


def measure_adam(n: int, repeats: int) -> None:
    tensors = {name: torch.randn(n, *shape).requires_grad_() for name, shape in SHAPES.items()}
    for tensor in tensors.values():
        tensor.grad = torch.randn_like(tensor)
    rates = dict.fromkeys(SHAPES, 1e-3) | {"sh": sh_rates(16, 1e-3, 1e-4)}
    for foreach in (False, True):
        library = torch.optim.Adam(tensors.values(), lr=1e-3, foreach=foreach)
        name = "foreach" if foreach else "loop"
        print(f"  torch {name:<11} {best_ms(library.step, repeats):9.2f} ms")
    for isa in _native.isas():
        _native.set_isa(isa)
        optimizer, seen = Adam(tensors), torch.rand(n // 100 + 1).repeat_interleave(100)[:n] < 0.3
        print(f"  native {isa:<10} {best_ms(partial(optimizer.step, tensors, rates), repeats):9.2f} ms", end="")
        print(f"   30 % seen {best_ms(partial(optimizer.step, tensors, rates, seen), repeats):9.2f} ms")
    _native.set_isa("auto")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--size", type=int, nargs=2, default=(1000, 1000), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--gaussians", type=int, nargs="*", default=[100_000, 1_000_000])
    parser.add_argument("--repeats", type=int, default=20)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    _native.set_threads(arguments.threads)
    print(f"{arguments.threads} threads")
    measure_loss(arguments.size[1], arguments.size[0], arguments.repeats)
    for n in arguments.gaussians:
        print(f"Adam, {n} Gaussians of degree 3:")
        measure_adam(n, arguments.repeats)


if __name__ == "__main__":
    main()
