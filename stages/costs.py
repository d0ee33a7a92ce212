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
    keypoints=MappingProxyType({"sift": 9000.0, "opencv-sift": 4300.0}),
    pairs=11.0,
    gaussians=1900.0,
    flat=0.86,
    stages=MappingProxyType(
        {
            "ingest": StageCosts(0.0177, 179e6, 0.0, 510.0),
            "control": StageCosts(1e-4, 180e6, 0.0, 10.0),
            "features": StageCosts(0.32, 130e6, 280e6, 156.0),
            "matches": StageCosts(1.5e-5, 240e6, 3200.0, 29.0),
            "sparse": StageCosts(7.0e-5, 280e6, 300.0, 33.0),
            "targets": StageCosts(1e-4, 250e6, 0.0, 10.0),
            "georef": StageCosts(0.01, 250e6, 0.0, 33.0),
            "undistort": StageCosts(0.028, 270e6, 15e6, 0.9e6),
            "split": StageCosts(1e-4, 270e6, 0.0, 18.0),
            "initialize": StageCosts(0.32, 550e6, 0.0, 200.0),
            "train": StageCosts(0.12, 475e6, 1.15, 249.0),
            "evaluate": StageCosts(0.48, 700e6, 1260.0, 0.8e6),
            "export": StageCosts(1.8e-5, 560e6, 1700.0, 360.0),
            "flythrough": StageCosts(0.3, 560e6, 0.0, 0.13e6),
        }
    ),
)
