"""Read splat files one after another in a separate process; report how each ended and what it took.

One line of JSON in (``format``, empty to detect it by content, and ``path``), one line out (``outcome``, ``detail``,
``cpu_s``, ``peak_bytes``). Linux only.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import time
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from splatpipe.pipeline.engine.errors import MachineError, SplatpipeError
from splatpipe.pipeline.splat.formats.catalogue import SPLAT_FORMATS
from splatpipe.pipeline.splat.formats.files import read_scene
from splatpipe.pipeline.splat.model.scene import Scene

SPARE_BYTES = 2 << 30  # address space above current use: reserved but unused memory does not count, up to a limit
STATUS = Path("/proc/self/status")

Reader = Callable[[Path], Scene]


def main() -> None:
    """Process requests until the input ends."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what readers print is not an answer
    torch.set_num_threads(1)
    warnings.simplefilter("error")  # a mere warning is a fault here
    readers = {each.name: each.read for each in SPLAT_FORMATS if each.reads} | {"": read_scene}
    for reader in readers.values():  # load the modules before memory is counted
        _read(reader, Path(os.devnull))
    limit = _kilobytes("VmSize") * 1024 + SPARE_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    answers.write("ready\n")
    for line in sys.stdin:
        asked = json.loads(line)
        answers.write(json.dumps(_measured(readers[asked["format"]], Path(asked["path"]))) + "\n")


def _measured(reader: Reader, path: Path) -> dict[str, Any]:
    Path("/proc/self/clear_refs").write_text("5")  # reset the peak: proc(5)
    before, start = _kilobytes("VmRSS"), time.process_time()
    outcome, detail = _read(reader, path)
    cpu_s, peak = time.process_time() - start, _kilobytes("VmHWM") - before
    return {"outcome": outcome, "detail": detail, "cpu_s": cpu_s, "peak_bytes": 1024 * peak}


def _read(reader: Reader, path: Path) -> tuple[str, str]:
    try:
        return "read", _fault(reader(path))
    except MachineError as error:
        return "memory", error.message[:300]
    except SplatpipeError as error:
        return "refused", f"{error.message} {error.hint}"[:300]
    except MemoryError:
        return "memory", "MemoryError"
    except BaseException as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        own = [frame for frame in traceback.extract_tb(error.__traceback__) if "splatpipe" in frame.filename]
        at = own[-1] if own else where
        text = " ".join(str(error).split())[:120]
        return "crashed", f"{type(error).__name__}: {text} ({Path(at.filename).name}:{at.lineno})"


def _fault(scene: Scene) -> str:
    """Return what is wrong with a scene that was read; empty if it is sound."""
    found = scene.gaussians
    if not all(bool(piece.finite().all()) for piece in found.pieces()):
        return "values that are not finite"
    if any(tensor.dtype != torch.float32 or tensor.device.type != "cpu" for tensor in found.tensors().values()):
        return "not float32 on the CPU"
    try:
        scene.facts.record()
    except ValueError as error:
        return f"facts that no file may carry: {error}"
    return ""


def _kilobytes(name: str) -> int:
    line = next(line for line in STATUS.read_text().splitlines() if line.startswith(f"{name}:"))
    return int(line.split()[1])


if __name__ == "__main__":
    main()
