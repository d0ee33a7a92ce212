"""When features by the CUDA kernels count as equal to the definition; for planted faults. Without torch."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from feature_frames import FeatureCase, FeatureOutcome, run_features
from frames import ORDERS, controls

from splatpipe.pipeline.raster.cuda.cuda_library import CudaLibrary

PICTURES = {"features": 1e-5, "alpha": 5e-6}
"""Largest differences, float32 against float64, relative to the largest value if that is above 1."""
GRADIENTS = 4e-5
"""L2 over all Gaussians, relative; what gradients are added to costs them a rounding of a half."""
NO_GRADIENT = 1e-6


@dataclass(frozen=True)
class FeatureTruth:
    """Cases, each with its outcome by the definition."""

    cases: list[tuple[FeatureCase, FeatureOutcome]]

    def complaints(self, library: CudaLibrary) -> Iterator[str]:
        """Yield what is wrong with the kernels, in every order of threads and with any chunks."""
        harness, firsts = controls(library), list[FeatureOutcome]()
        harness.harness_multiprocessors(1)  # so that blocks take several turns
        for turn, order in enumerate(ORDERS):
            harness.harness_order(*order)
            for number, (case, exact) in enumerate(self.cases):
                ours = run_features(library, case)
                yield from disagreements(ours, exact)
                if turn == 0:
                    firsts.append(ours)
                yield from (f"{name} of features differs by order" for name in ours.differs(firsts[number]))
                pairs = ours.facts[0]
                again = run_features(library, case, (pairs // 3, pairs // 3, pairs - 1)[turn], turn + 1)
                yield from (f"{name} of features differs by chunks" for name in again.differs(ours))


def disagreements(ours: FeatureOutcome, exact: FeatureOutcome) -> Iterator[str]:
    """Yield the differences of images, radii and gradients from the definition."""
    for name, limit in PICTURES.items():
        truth = exact.pictures[name]
        worst = float(np.abs(ours.pictures[name].astype(np.float64) - truth).max(initial=0.0))
        if not worst <= limit * max(1.0, float(np.abs(truth).max(initial=0.0))):
            yield f"{name} differ by up to {worst:.1e}"
    if (ours.pictures["radii"] != exact.pictures["radii"]).any():
        yield "radii of features differ"
    for name, truth in exact.gradients.items():
        error = float(np.linalg.norm(ours.gradients[name].astype(np.float64) - truth))
        error /= max(float(np.linalg.norm(truth)), NO_GRADIENT)
        if not error <= GRADIENTS:
            yield f"gradient of {name}: {error:.1e}"
