"""What a unit of each stage's work costs: constants of forecasts, fitted to finished runs. Light to import.

`benchmarks/forecast.py --costs` fits and prints them; `benchmarks/forecast.json` has the runs, at `preview` with two
threads of a shared 2-core x86-64 machine with AVX-512, whose CPU seconds these are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


@dataclass(frozen=True)
class StageCosts:
    """Of one stage; `work.py` says what its units are.

    Attributes:
        cpu: Seconds of a unit of CPU time.
        resident: Bytes of its process whatever the size: interpreter, libraries, their buffers.
        memory: Bytes of a unit of what grows.
        disk: Bytes of a unit of what it leaves.
    """

    cpu: float
    resident: float
    memory: float
    disk: float


@dataclass(frozen=True)
class Costs:
    """Constants of forecasts.

    Attributes:
        keypoints: Of a megapixel in which they are looked for, by extractor.
        pairs: Of a photo, where not all are matched, with 20 neighbours.
        gaussians: Of a photo, after `preview`'s density control.
        flat: Share of its iterations after which a training ends, where it may when its loss is flat.
        stages: By name.
    """

    keypoints: Mapping[str, float]
    pairs: float
    gaussians: float
    flat: float
    stages: Mapping[str, StageCosts]


REFERENCE = Costs(
    keypoints=MappingProxyType({"sift": 9000.0, "opencv-sift": 4061.0}),
    pairs=10.5,
    gaussians=1880.0,
    flat=0.855,
    stages=MappingProxyType(
        {
            "ingest": StageCosts(0.0153, 179e6, 0.0, 508.0),
            "control": StageCosts(0.1, 180e6, 0.0, 1200.0),
            "features": StageCosts(0.341, 115e6, 282e6, 156.0),
            "matches": StageCosts(1.44e-05, 250e6, 185e6, 30.1),
            "sparse": StageCosts(6.86e-05, 282e6, 405.0, 30.4),
            "targets": StageCosts(0.21, 230e6, 100e6, 1300.0),
            "georef": StageCosts(0.0244, 235e6, 288.0, 30.4),
            "undistort": StageCosts(0.0304, 290e6, 15.6e6, 0.911e6),
            "split": StageCosts(0.0001, 284e6, 0.0, 18.3),
            "initialize": StageCosts(0.336, 569e6, 0.0, 225.0),
            "train": StageCosts(0.134, 561e6, 1.0, 249.0),
            "evaluate": StageCosts(0.508, 767e6, 500.0, 0.76e6),
            "export": StageCosts(1.97e-05, 651e6, 560.0, 374.0),
            "flythrough": StageCosts(0.3, 574e6, 0.0, 0.13e6),
        }
    ),
)
