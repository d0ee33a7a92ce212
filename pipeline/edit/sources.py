"""The input of an edit: a splat file or model folder, or a run's OUT, whose `splat.ply` and cameras are used."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splatpipe.pipeline.engine.digests import part_digest, tree_entries
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.json_file import read_json
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.splat.containers.bounded import CheckValues, check_values
from splatpipe.pipeline.splat.formats.files import read_scene
from splatpipe.pipeline.splat.model.scene import Scene

SPLAT, CAMERAS, METRICS, STAGES = "splat.ply", "cameras.json", "metrics.json", "stages"
MAX_CAMERAS_BYTES = 64 << 20  # bytes: enough for about 100,000 photos
MAX_PICTURE_SIDE = 65_536  # pixels per side


@dataclass(frozen=True)
class SplatSource:
    """An existing splat.

    Attributes:
        path: Its file, or the folder of a model.
        run: The OUT of the run it belongs to, or None.
    """

    path: Path
    run: Path | None

    @property
    def name(self) -> str:
        """The splat's display name."""
        return self.path.name if self.run is None else self.run.name

    def read(self, check: CheckValues = check_values) -> Scene:
        """Read the splat.

        Args:
            check: What to do about unusable values.

        Raises:
            SplatpipeError: if it is broken.
        """
        return read_scene(self.path, check)

    def digest(self) -> str:
        """sha256 of its content, which identifies it."""
        entries = tree_entries(self.path, self.path)
        return entries[0].sha256 if self.path.is_file() else part_digest(entries, "")

    def cameras(self) -> list[Camera]:
        """The run's cameras in the splat's frame, z up; empty if there are none or their file is damaged."""
        return [] if self.run is None else read_cameras(self.run / CAMERAS)

    def trained_on(self) -> list[Camera]:
        """The cameras of the training photos, without held-out views."""
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
    """Read cameras in the format of 3DGS viewers: poses and focal lengths, with a centred principal point.

    Args:
        path: `cameras.json`.

    Returns:
        The valid ones; empty if the file is missing or damaged, in which case images are made without them.
    """
    try:
        listed = read_json(path, MAX_CAMERAS_BYTES)
        return [camera for entry in listed if (camera := _camera(entry)) is not None]
    except (OSError, ValueError, TypeError, KeyError):
        return []


def _held_out(path: Path) -> set[str]:
    """Names of a run's held-out photos; empty if its metrics are missing or damaged."""
    try:
        return {str(view["name"]) for view in read_json(path, MAX_CAMERAS_BYTES)["per_view"]}
    except (OSError, ValueError, TypeError, KeyError):
        return set()


def _camera(entry: dict[str, Any]) -> Camera | None:
    rotation = np.array(entry["rotation"], np.float64).reshape(3, 3)
    centre = np.array(entry["position"], np.float64).reshape(3)
    width, height = int(entry["width"]), int(entry["height"])
    focal = float(entry["fx"]), float(entry["fy"])
    sane = np.isfinite(centre).all() and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)
    if not (sane and all(math.isfinite(f) and f > 0.0 for f in focal)):
        return None
    if not (0 < width <= MAX_PICTURE_SIDE and 0 < height <= MAX_PICTURE_SIDE):
        return None
    pose = np.eye(4)
    pose[:3, :3] = rotation.T
    pose[:3, 3] = -rotation.T @ centre
    return Camera(str(entry["img_name"]), width, height, *focal, width / 2.0, height / 2.0, pose)
