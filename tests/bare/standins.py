"""Parts of a visit to a GPU that stand in for those that need a card."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from gpu_parts import Refusal, Row


def succeeds(**arguments: object) -> Iterator[Row]:
    yield {"stand_in": sorted(arguments)}


def fails(**arguments: object) -> Iterator[Row]:
    yield {"stand_in": sorted(arguments)}
    raise SystemExit("it broke")


def crashes(**arguments: object) -> Iterator[Row]:
    yield {"stand_in": sorted(arguments)}
    os.kill(os.getpid(), signal.SIGSEGV)


def refuses(**arguments: object) -> Iterator[Row]:
    yield from ()
    raise Refusal("not on this machine")


def hangs(**arguments: object) -> Iterator[Row]:
    """Hang with a process that it has started, both deaf to SIGTERM."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    child = subprocess.Popen([sys.executable, "-S", "-c", "import time; time.sleep(600)"])
    yield {"child": child.pid}
    time.sleep(600)


def compiles(peer: str) -> Iterator[Row]:
    """Compile long enough to be waited for."""
    time.sleep(1.0)
    yield {"peer": peer}


def same_bits(iterations: int) -> Iterator[Row]:
    yield {"same": True, "digests": [str(iterations)]}


def profiles(count: int, megapixels: float) -> Iterator[Row]:
    yield {"kernel": "splat::cuda::blend_kernel(Job, int)", "calls": 1.0, "us": 900.0, "share": 0.6}


def peer_speed(peer: str, count: int | None, **arguments: object) -> Iterator[Row]:
    row: Row = {"peer": peer, "version": "0", "scene": "made" if count else "trained", "count": count or 150}
    row |= {"optimiser": "another", "ssim": "another", "iteration_ms": 10.0, "peak_gb": 1.0}
    yield row | {"raster_ms": 5.0, "raster_peak_gb": 1.0}


def trains(seed: int, iterations: int) -> Iterator[Row]:
    yield {"seed": seed, "iterations": iterations, "psnr_cc": 20.0 + 0.01 * seed, "train_seconds": 1.0}


def trains_here(seed: int, iterations: int) -> Iterator[Row]:
    """Train and evaluate as on a card, on the CPU: everything that this imports has to be there."""
    import gpu_proofs

    yield from gpu_proofs.training(seed, iterations, on="cpu", megapixels=0.002)


def is_bare(**arguments: object) -> Iterator[Row]:
    """Report which of the packages that the machine lacks can be imported, and from where the carried ones come."""
    import importlib

    found = {}
    for name in ("pydantic", "tomli_w", "kornia", "pycolmap", "trimesh", "pyproj", "beartype", "starlette"):
        try:
            found[name] = str(Path(importlib.import_module(name).__file__ or "").parent)
        except ModuleNotFoundError:
            found[name] = ""
    yield found
