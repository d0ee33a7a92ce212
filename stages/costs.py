"""What a unit of each stage's work costs: constants of forecasts, fitted to finished runs. Light to import.

Fitted by `benchmarks/forecast.py` to eight captures at `preview`, two threads of a shared 2-core x86-64 machine with
AVX-512: seconds are CPU seconds of that machine.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

MB = 1_000_000


@dataclass(frozen=True)
class Costs:
    """Constants of forecasts; what a unit of work is, `work.py` says stage by stage.

    Attributes:
        keypoints: Of a megapixel in which they are looked for, by extractor.
        pairs: Of a photo, where they are chosen by positions or by sequence, with 20 neighbours.
        gaussians: Of a megapixel of all training photos together, after `preview`'s density control.
        cpu: Seconds of a unit of each stage's work.
        memory: Bytes of a unit of what grows in each stage.
        resident: Bytes of each stage's process whatever the size: interpreter, libraries, their buffers.
        disk: Bytes that a unit of each stage's result takes.
    """

    keypoints: Mapping[str, float] = field(default_factory=lambda: {"sift": 9000.0, "opencv-sift": 3500.0})
    pairs: float = 12.0
    gaussians: float = 7500.0
    cpu: Mapping[str, float] = field(
        default_factory=lambda: {
            "ingest": 0.006,
            "features": 0.28,
            "matches": 1.4e-5,
            "sparse": 7.0e-5,
            "georef": 0.01,
            "undistort": 0.03,
            "split": 1e-4,
            "initialize": 0.27,
            "train": 0.1,
            "evaluate": 0.43,
            "export": 1.3e-5,
            "flythrough": 0.3,
        }
    )
    memory: Mapping[str, float] = field(
        default_factory=lambda: {
            "ingest": 1.0 * MB,
            "features": 250.0 * MB,
            "matches": 0.01 * MB,
            "sparse": 400.0,
            "georef": 200.0,
            "undistort": 30.0 * MB,
            "split": 0.0,
            "initialize": 100.0 * MB,
            "train": 1.0,
            "evaluate": 500.0,
            "export": 700.0,
            "flythrough": 500.0,
        }
    )
    resident: Mapping[str, float] = field(
        default_factory=lambda: {
            "ingest": 175.0 * MB,
            "features": 180.0 * MB,
            "matches": 220.0 * MB,
            "sparse": 250.0 * MB,
            "georef": 240.0 * MB,
            "undistort": 240.0 * MB,
            "split": 240.0 * MB,
            "initialize": 480.0 * MB,
            "train": 600.0 * MB,
            "evaluate": 650.0 * MB,
            "export": 600.0 * MB,
            "flythrough": 600.0 * MB,
        }
    )
    disk: Mapping[str, float] = field(
        default_factory=lambda: {
            "ingest": 600.0,
            "features": 156.0,
            "matches": 30.0,
            "sparse": 38.0,
            "georef": 38.0,
            "undistort": 0.9 * MB,
            "split": 100.0,
            "initialize": 248.0,
            "train": 248.0,
            "evaluate": 0.65 * MB,
            "export": 320.0,
            "flythrough": 0.13 * MB,
        }
    )


REFERENCE = Costs()
