"""What each stage takes by the sizes of a run: constants fitted to finished runs. Light to import.

CPU time is a power law of a few sizes; memory and disk space are sums of them. `sizes.py` defines the sizes.
`python benchmarks forecast --costs` fits and prints the constants; `benchmarks/line/forecast.json` has the runs, at
`preview` with two threads on a shared 2-core x86-64 machine with AVX-512. CPU seconds are those of that machine.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from splatpipe.pipeline.engine.runs.needs import Need
from splatpipe.pipeline.train.plan.limits import LIBRARIES_BYTES

Sizes = Mapping[str, float]
"""The sizes of a run, by name."""


def total(costs: Sizes, sizes: Sizes) -> float:
    """Return the sum of the costs of sizes."""
    return sum(each * sizes[name] for name, each in costs.items())


@dataclass(frozen=True)
class StageCosts:
    """Costs of one stage.

    Attributes:
        cpu: CPU seconds where each size of ``powers`` is 1.
        powers: Exponents of the sizes that CPU time grows with.
        parallel: Share of the CPU time that is divided among the threads; measured with one and two.
        resident: Bytes of memory of its process at any size: interpreter, libraries, their buffers.
        memory: Bytes of memory per unit of each size that it grows with.
        disk: Bytes of output per unit of each size.
    """

    cpu: float
    powers: Sizes
    parallel: float
    resident: float
    memory: Sizes
    disk: Sizes

    def need(self, sizes: Sizes) -> Need:
        """Return what the stage takes at these sizes on the reference machine, without scratch space."""
        memory = self.resident + total(self.memory, sizes)
        return Need(int(memory), self.cpu * self.work(sizes), int(total(self.disk, sizes)), parallel=self.parallel)

    def work(self, sizes: Sizes) -> float:
        """Return the product of sizes that CPU time is proportional to."""
        return math.prod(float(sizes[name] ** power) for name, power in self.powers.items())


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


FORMAT_COSTS: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "viewer-ply": (0.1, 248.0),
        "compressed-ply": (0.12, 61.0),
        "spz": (0.16, 22.5),
        "spz2": (0.14, 21.5),
        "model": (0.04, 248.0),
        "sog": (6.3, 31.0),
        "glb": (0.1, 240.0),
        "tiles": (2.1, 46.0),
        "streamed-sog": (13.8, 66.0),
        "web": (2.1, 46.0),
        "laz": (0.1, 12.0),
    }
)
"""CPU time of each of `export.formats`, over that of an export without any, and its bytes per Gaussian.

From 59,000 and 103,000 Gaussians of SH degree 3 (brighton, demo); per Gaussian, SOG of a million takes half. Those of
several levels include 1.8 for the levels, which are made once for all of them."""
WITH_PHOTOS = frozenset({"colmap", "transforms"})
"""Formats that include a folder of the undistorted photos, which they share."""

MAPPED = {"keypoints": 720, "retried_at_once": 250e6}  # an upper bound: unplaced photos get further keypoints
EXPORTED = {"gaussians": 375, "format_bytes": 1, "exported_dataset": 0.598e6}
STAGES = {
    "ingest": StageCosts(0.013, {"pixels": 1}, 0.8, 181e6, {}, {"photos": 508}),
    "control": StageCosts(0.1, {}, 0.0, 180e6, {}, {}),
    "features": StageCosts(0.287, {"searched": 1}, 0.98, 157e6, {"searched_at_once": 266e6}, {"keypoints": 156}),
    "matches": StageCosts(1.36e-5, {"compared": 1}, 0.97, 250e6, {"threads": 185e6}, {"keypoints": 30.1}),
    "sparse": StageCosts(0.472, {"photos": 1, "crowd": 0.75, "doubt": 1}, 0.2, 215e6, MAPPED, {"keypoints": 31.2}),
    "targets": StageCosts(0.21, {"control_pixels": 1}, 0.0, 230e6, {"tiles_at_once": 100e6}, {}),
    "georef": StageCosts(0.019, {"photos": 1}, 0.0, 157e6, {"keypoints": 724}, {"keypoints": 30.4}),
    "undistort": StageCosts(0.0363, {"pixels": 1}, 0.8, 241e6, {"pixels_at_once": 18.2e6}, {"dataset": 0.598e6}),
    "split": StageCosts(0.0001, {"photos": 1}, 0.0, 264e6, {}, {"photos": 18.3}),
    "initialize": StageCosts(0.292, {"dense_photos": 1}, 0.85, 546e6, {}, {"gaussians": 41.2}),
    "blocks": StageCosts(0.0876, {"coarse_work": 1}, 0.93, LIBRARIES_BYTES, {"coarse_bytes": 1}, {"coarse": 249}),
    "train": StageCosts(0.0876, {"work": 1}, 0.93, LIBRARIES_BYTES, {"training_bytes": 1}, {"written": 249}),
    "clean": StageCosts(1.5, {"seen": 1}, 0.75, 620e6, {"gaussians": 560}, {"gaussians": 249}),
    "evaluate": StageCosts(1.74, {"judged": 1}, 0.75, 1215e6, {"gaussians": 500}, {"judged": 4.85e6}),
    "export": StageCosts(2.07e-5, {"exported": 1}, 0.2, 620e6, {"gaussians": 560}, EXPORTED),
    "flythrough": StageCosts(0.3, {"filmed": 1}, 0.7, 486e6, {}, {"filmed": 0.13e6}),
    "depths": StageCosts(12.0, {"depths": 1}, 0.97, 690e6, {}, {"depths": 5e6}),
    "splat_depths": StageCosts(3.0, {"depths": 1}, 0.9, 600e6, {}, {"depths": 5e6}),
    "dsm": StageCosts(0.35, {"pixels": 1}, 0.9, 1000e6, {}, {"pixels": 0.2e6}),
    "dtm": StageCosts(0.05, {"pixels": 1}, 0.8, 700e6, {}, {"pixels": 0.3e6}),
    "ortho": StageCosts(0.4, {"pixels": 1}, 0.9, 1250e6, {}, {"pixels": 0.5e6}),
    "facades": StageCosts(1.0, {"pixels": 1}, 0.8, 1000e6, {}, {"pixels": 0.2e6}),
    "cloud": StageCosts(2.0, {"pixels": 1}, 0.9, 1500e6, {}, {"pixels": 0.5e6}),
    "mesh": StageCosts(2.0, {"pixels": 1}, 0.5, 2800e6, {}, {"pixels": 0.5e6}),
    "publish": StageCosts(0.05, {"pixels": 1}, 0.0, 600e6, {}, {"pixels": 0.1e6}),
}
"""CPU seconds at sizes of 1, exponents, parallel share, resident bytes, bytes of memory and of output by size."""
SCRATCH: Mapping[str, Sizes] = MappingProxyType(
    {
        "matches": {"keypoints": 156},  # a copy of the features
        "sparse": {"keypoints": 156},
        "blocks": {"coarse_cached": 4e6, "coarse": 1440},  # decoded photos with their pyramids, and checkpoints
        "train": {"cached": 4e6, "checkpoint_bytes": 1},
    }
)
"""Bytes on disk by size while a stage runs."""

REFERENCE = Costs(
    keypoints=MappingProxyType({"sift": 9000.0, "opencv-sift": 3288.0}),
    pairs=11.1,
    gaussians=1860.0,
    flat=0.851,
    stages=MappingProxyType(STAGES),
)
