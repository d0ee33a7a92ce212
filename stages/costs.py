"""Cost per unit of work of each stage: constants for forecasts, fitted to finished runs. Light to import.

`python benchmarks forecast --costs` fits and prints them; `benchmarks/line/forecast.json` has the runs, at `preview`
with two threads on a shared 2-core x86-64 machine with AVX-512. CPU seconds are those of that machine.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


@dataclass(frozen=True)
class StageCosts:
    """Costs of one stage; `work.py` defines its units.

    Attributes:
        cpu: CPU seconds per unit.
        resident: Bytes of memory of its process at any size: interpreter, libraries, their buffers.
        memory: Bytes of memory per unit.
        disk: Bytes of output per unit.
    """

    cpu: float
    resident: float
    memory: float
    disk: float


@dataclass(frozen=True)
class FormatCosts:
    """Costs per Gaussian of one of `export.formats`.

    Attributes:
        cpu: CPU seconds.
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
"""From 59,000 and 103,000 Gaussians of SH degree 3 (brighton, demo); per Gaussian, SOG of a million takes half."""
LEVELS_CPU = 3.8e-5
"""CPU seconds per Gaussian for the levels of detail, which are made once for all streamed formats."""
IN_LEVELS = frozenset({"tiles", "streamed-sog", "web"})
WITH_PHOTOS = frozenset({"colmap", "transforms"})
"""Formats that include a folder of the undistorted photos, which they share."""


@dataclass(frozen=True)
class Costs:
    """Constants of forecasts.

    Attributes:
        keypoints: Per megapixel of the images they are extracted from, by extractor.
        pairs: Per photo, unless matching is exhaustive, with 20 neighbours.
        gaussians: Per photo, after `preview`'s density control.
        flat: Share of the iterations after which training ends if it may stop when the loss is flat.
        stages: Costs by stage name.
    """

    keypoints: Mapping[str, float]
    pairs: float
    gaussians: float
    flat: float
    stages: Mapping[str, StageCosts]


REFERENCE = Costs(
    keypoints=MappingProxyType({"sift": 9000.0, "opencv-sift": 3288.0}),
    pairs=11.1,
    gaussians=1860.0,
    flat=0.851,
    stages=MappingProxyType(
        {
            "ingest": StageCosts(0.013, 181e6, 0.0, 508.0),
            "control": StageCosts(0.1, 180e6, 0.0, 1200.0),
            "features": StageCosts(0.287, 157e6, 266e6, 156.0),
            "matches": StageCosts(1.36e-05, 250e6, 185e6, 30.1),
            "sparse": StageCosts(0.548, 215e6, 347e6, 31.4),
            "targets": StageCosts(0.21, 230e6, 100e6, 1300.0),
            "georef": StageCosts(0.019, 157e6, 724.0, 30.4),
            "undistort": StageCosts(0.0363, 241e6, 18.2e6, 0.598e6),
            "split": StageCosts(0.0001, 259e6, 0.0, 18.3),
            "initialize": StageCosts(0.292, 538e6, 0.0, 206.0),
            "train": StageCosts(0.0896, 340e6, 1.0, 249.0),
            "clean": StageCosts(1.5, 620e6, 560.0, 249.0),
            "evaluate": StageCosts(0.217, 1215e6, 500.0, 0.606e6),
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
