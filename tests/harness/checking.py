"""The CUDA kernels' checks, for planted faults: the same that the kernels pass. Without torch.

As a program, it runs the checks on each fault of a library in a process of its own, since faulty kernels may crash.
"""

from __future__ import annotations

import json
import os
import pickle
import signal
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from agreement import gradient_complaints, picture_complaints
from frames import ORDERS, RenderCase, RenderOutcome, controls, run
from training import Draws, Loss, step_complaints

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.raster.cuda.cuda_library import CudaLibrary

TIMEOUT_S = 60
"""Far longer than all checks of one fault: detects endless loops."""


class Truth(Protocol):
    """What kernels are checked against."""

    def complaints(self, library: CudaLibrary) -> Iterator[str]:
        """Yield what is wrong with the kernels; nothing if they are right."""


@dataclass(frozen=True)
class ReferenceResult:
    """Results by the definition: images and gradients of frames, a loss, draws, and images of a large frame."""

    frames: list[tuple[RenderCase, RenderOutcome]]
    loss: Loss
    draws: Draws
    large: tuple[RenderCase, RenderOutcome]

    def complaints(self, library: CudaLibrary) -> Iterator[str]:
        """Yield what is wrong with the kernels; nothing if they are right."""
        harness = controls(library)
        harness.harness_multiprocessors(1)  # so that blocks take several turns
        firsts: list[RenderOutcome] = []
        for turn, order in enumerate(ORDERS):
            harness.harness_order(*order)
            for number, (case, exact) in enumerate(self.frames):
                ours = run(library, case)
                yield from picture_complaints(ours, exact)
                yield from gradient_complaints(ours, exact)
                if turn == 0:
                    firsts.append(ours)
                yield from (f"{name} differs by order" for name in ours.differs(firsts[number]))
                pairs = ours.facts[0]
                again = run(library, case, (pairs // 3, pairs // 3, pairs - 1)[turn], turn + 1)
                yield from (f"{name} differs by chunks" for name in again.differs(ours))
                yield from step_complaints(library, case, exact)
            case, exact = self.large
            yield from picture_complaints(run(library, case), exact)
            yield from self.loss.complaints(library)
            yield from self.draws.complaints(library)


def first_complaint(library: CudaLibrary, truth: Truth) -> str:
    """Return the first of ``complaints``, including a failure to run at all; empty if there is none."""
    np.seterr(all="ignore")  # poison is signalling NaN
    try:
        return next(truth.complaints(library), "")
    except (MachineError, AssertionError) as error:
        return str(error)


def in_a_process(library: CudaLibrary, truth: Truth, fault: int) -> str:
    """Return ``first_complaint`` with a fault active, or how the process ended."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        signal.alarm(TIMEOUT_S)
        controls(library).harness_fault(fault)
        os.write(writing, first_complaint(library, truth).encode()[:4000])
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as pipe:
        said = pipe.read().decode()
    _, status = os.waitpid(child, 0)
    return f"ended by signal {os.WTERMSIG(status)}" if os.WIFSIGNALED(status) else said


def main() -> None:
    """Print the findings for each fault, no fault first. Arguments: library, pickled truth, number of faults."""
    library = CudaLibrary(Path(sys.argv[1]))
    truth = pickle.loads(Path(sys.argv[2]).read_bytes())
    print(json.dumps([in_a_process(library, truth, fault) for fault in range(int(sys.argv[3]) + 1)]))


if __name__ == "__main__":
    sys.modules["checking"] = sys.modules["__main__"]  # the module name in the pickled classes
    main()
