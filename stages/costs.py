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
class FormatCosts:
    """Of one of `export.formats`, a Gaussian.

    Attributes:
        cpu: Seconds of CPU time.
        disk: Bytes.
    """

    cpu: float
    disk: float


FORMAT_COSTS: Mapping[str, FormatCosts] = MappingProxyType(
    {
        "viewer-ply": FormatCosts(2.0e-6, 248.0),
        "compressed-ply": FormatCosts(2.5e-6, 61.0),
        "spz": FormatCosts(3.4e-6, 22.5),
        "spz2": FormatCosts(2.9e-6, 21.5),
        "model": FormatCosts(0.8e-6, 248.0),
        "sog": FormatCosts(1.3e-4, 31.0),
        "glb": FormatCosts(2.0e-6, 240.0),
        "tiles": FormatCosts(6.0e-6, 46.0),
        "streamed-sog": FormatCosts(2.5e-4, 66.0),
        "web": FormatCosts(7.0e-6, 46.0),
        "laz": FormatCosts(2.0e-6, 12.0),
    }
)
"""Of 59,000 and 103,000 Gaussians of degree 3 (brighton, demo); a SOG of a million takes half as long a Gaussian."""
LEVELS_CPU = 3.8e-5
"""Seconds of a Gaussian of the levels of detail, which are made once for all that are streamed."""
IN_LEVELS = frozenset({"tiles", "streamed-sog", "web"})
WITH_PHOTOS = frozenset({"colmap", "transforms"})
"""Have a folder of the undistorted photos, one for both."""


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
    gaussians=1860.0,
    flat=0.851,
    stages=MappingProxyType(
        {
            "ingest": StageCosts(0.013, 181e6, 0.0, 508.0),
            "control": StageCosts(0.1, 180e6, 0.0, 1200.0),
            "features": StageCosts(0.287, 157e6, 266e6, 156.0),
            "matches": StageCosts(1.36e-05, 250e6, 185e6, 30.1),
            "sparse": StageCosts(6.32e-05, 215e6, 723.0, 30.4),
            "targets": StageCosts(0.21, 230e6, 100e6, 1300.0),
            "georef": StageCosts(0.019, 157e6, 724.0, 30.4),
            "undistort": StageCosts(0.0363, 241e6, 18.2e6, 0.598e6),
            "split": StageCosts(0.0001, 259e6, 0.0, 18.3),
            "initialize": StageCosts(0.292, 538e6, 0.0, 206.0),
            "train": StageCosts(0.0896, 340e6, 1.0, 249.0),
            "clean": StageCosts(1.5, 620e6, 560.0, 249.0),
            "evaluate": StageCosts(0.303, 1215e6, 500.0, 0.844e6),
            "export": StageCosts(2.07e-05, 620e6, 560.0, 375.0),
            "flythrough": StageCosts(0.3, 486e6, 0.0, 0.13e6),
            "depths": StageCosts(12.0, 690e6, 0.0, 5e6),
            "splat_depths": StageCosts(3.0, 600e6, 0.0, 5e6),
            "dsm": StageCosts(0.35, 1000e6, 0.0, 0.2e6),
            "ortho": StageCosts(0.4, 1250e6, 0.0, 0.5e6),
            "facades": StageCosts(1.0, 1000e6, 0.0, 0.2e6),
            "cloud": StageCosts(2.0, 1500e6, 0.0, 0.5e6),
            "mesh": StageCosts(2.0, 2800e6, 0.0, 0.5e6),
        }
    ),
)
