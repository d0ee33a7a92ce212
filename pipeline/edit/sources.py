"""What is edited: a splat's file or model folder, or the OUT of a run, whose `splat.ply` and cameras are taken."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splatpipe.pipeline.engine.digests import part_digest, tree_entries
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.splat.formats.files import read_scene
from splatpipe.pipeline.splat.scene import Scene

SPLAT, CAMERAS, METRICS, STAGES = "splat.ply", "cameras.json", "metrics.json", "stages"
LARGEST_CAMERAS = 64 << 20  # bytes: of some 100,000 photos
LARGEST_PICTURE = 65_536  # pixels a side


@dataclass(frozen=True)
class SplatSource:
    """A splat that is there.

    Attributes:
        path: Its file, or the folder of a model.
        run: The OUT that it lies in as a run's; None else.
    """

    path: Path
    run: Path | None

    @property
    def name(self) -> str:
        """What people call it."""
        return self.path.name if self.run is None else self.run.name

    def read(self) -> Scene:
        """The splat.

        Raises:
            SplatpipeError: if it is broken.
        """
        return read_scene(self.path)

    def digest(self) -> str:
        """sha256 of its bytes, by which it is known again."""
        entries = tree_entries(self.path, self.path)
        return entries[0].sha256 if self.path.is_file() else part_digest(entries, "")

    def cameras(self) -> list[Camera]:
        """The run's cameras in the splat's frame, z up; none where there are none or their file is damaged."""
        return [] if self.run is None else read_cameras(self.run / CAMERAS)

    def trained_on(self) -> list[Camera]:
        """Those of its cameras whose photos were trained on."""
        held_out = set() if self.run is None else _held_out(self.run / METRICS)
        return [camera for camera in self.cameras() if camera.name not in held_out]


def open_source(path: Path) -> SplatSource:
    """Find a splat.

    Args:
        path: A file, the folder of a model, or a run's OUT.

    Raises:
        SplatpipeError: if there is none.
    """
    if is_run(path):
        if not (path / SPLAT).is_file():
            raise SplatpipeError(f"{path} has no {SPLAT} yet.", hint=f"Finish the run: splatpipe run PHOTOS {path}")
        return SplatSource(path / SPLAT, path)
    if not path.exists():
        raise SplatpipeError(f"There is no {path}.", hint="Give a splat file, or the OUT of a run.")
    beside = path.name == SPLAT and is_run(path.parent)
    return SplatSource(path, path.parent if beside else None)


def is_run(path: Path) -> bool:
    """Whether a folder is a run's OUT."""
    return (path / STAGES).is_dir()


def read_cameras(path: Path) -> list[Camera]:
    """Cameras as viewers of 3DGS have them: poses and focal lengths, the principal point in the middle.

    Args:
        path: `cameras.json`.

    Returns:
        Those that make sense; none of a file that is not there or damaged: pictures are made without them, then.
    """
    try:
        if path.stat().st_size > LARGEST_CAMERAS:
            return []
        listed = json.loads(path.read_text(encoding="utf-8"))
        return [camera for entry in listed if (camera := _camera(entry)) is not None]
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return []


def _held_out(path: Path) -> set[str]:
    """Names of the photos that a run judged itself by; none where its figures are not there or damaged."""
    try:
        if path.stat().st_size > LARGEST_CAMERAS:
            return set()
        return {str(view["name"]) for view in json.loads(path.read_text(encoding="utf-8"))["per_view"]}
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return set()


def _camera(entry: dict[str, Any]) -> Camera | None:
    rotation = np.array(entry["rotation"], np.float64).reshape(3, 3)
    centre = np.array(entry["position"], np.float64).reshape(3)
    width, height = int(entry["width"]), int(entry["height"])
    focal = float(entry["fx"]), float(entry["fy"])
    sane = np.isfinite(centre).all() and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)
    if not (sane and all(math.isfinite(f) and f > 0.0 for f in focal)):
        return None
    if not (0 < width <= LARGEST_PICTURE and 0 < height <= LARGEST_PICTURE):
        return None
    pose = np.eye(4)
    pose[:3, :3] = rotation.T
    pose[:3, 3] = -rotation.T @ centre
    return Camera(str(entry["img_name"]), width, height, *focal, width / 2.0, height / 2.0, pose)
