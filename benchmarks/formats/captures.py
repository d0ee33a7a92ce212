"""A run's deliverable to be measured: its splat and the cameras of the held-out photos, both in the survey frame."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.splat.formats.files import read_scene
from splatpipe.pipeline.splat.model.scene import Axes, Scene

Picture = Float[np.ndarray, "h w 3"]
NEAR_M = 0.1
MAX_PIXELS = 500_000  # largest image that is compared; larger ones are reduced
HALF_TURN = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
AXES: tuple[Axes, ...] = ("z up", "y up", "y down")


@dataclass(frozen=True, eq=False)
class CaptureRun:
    """A finished run.

    Attributes:
        name: Name of its folder.
        scene: `splat.ply`, z up.
        cameras: Cameras of the held-out photos, in the frame of the splat.
    """

    name: str
    scene: Scene
    cameras: list[Camera]

    def pictures(self, scene: Scene) -> list[Picture]:
        """Render a splat in any axes from all cameras, on black, 0..1, before rounding."""
        turned = scene.turned("z up").gaussians
        options = rasterizer.RenderOptions(
            sh_degree=turned.sh_degree, antialias=self.scene.facts.antialias, near=NEAR_M, depth=False
        )
        with torch.no_grad():
            colours = (rasterizer.render(turned, camera, options).colour for camera in self.cameras)
            return [np.asarray(colour.clamp(0.0, 1.0).numpy(), np.float64) for colour in colours]


def open_capture(out: Path, most_views: int = 5) -> CaptureRun:
    """Open a finished run.

    Raises:
        UsageError: if the run is not finished.
        SplatpipeError: if its splat is broken.
    """
    try:
        metrics = json.loads((out / "metrics.json").read_text(encoding="utf-8"))
        rows = json.loads((out / "cameras.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UsageError(f"{out} is no finished run.", hint="splatpipe run PHOTOS OUT, to the end.") from error
    held_out = {view["name"] for view in metrics["per_view"]}
    cameras = [_camera(row) for row in rows if row["img_name"] in held_out]
    return CaptureRun(out.name, read_scene(out / "splat.ply"), cameras[:most_views])


def _camera(row: dict[str, object]) -> Camera:
    """Read a camera as in a 3DGS `cameras.json`: world-from-camera rotation, centre; centred principal point."""
    width, height = int(row["width"]), int(row["height"])  # type: ignore[call-overload]
    pose = np.eye(4)
    pose[:3, :3] = np.array(row["rotation"], float).T
    pose[:3, 3] = -pose[:3, :3] @ np.array(row["position"], float)
    fx, fy = float(row["fx"]), float(row["fy"])  # type: ignore[arg-type]
    camera = Camera(str(row["img_name"]), width, height, fx, fy, width / 2.0, height / 2.0, pose)
    shrink = math.sqrt(min(1.0, MAX_PIXELS / (width * height)))
    return camera.scaled(round(width * shrink), round(height * shrink))


def decibels(pictures: Sequence[Picture], originals: Sequence[Picture]) -> float:
    """Return the PSNR over all images together; infinite if they are identical."""
    errors = [float(np.mean((a - b) ** 2)) for a, b in zip(pictures, originals, strict=True)]
    mean = sum(errors) / len(errors)
    return -10.0 * math.log10(mean) if mean > 0.0 else math.inf


def likely_frame(capture: CaptureRun, scene: Scene, originals: Sequence[Picture]) -> tuple[str, Scene]:
    """Return the frame in which a splat looks most like the original from the first camera: its name, and the splat.

    Candidates are all axis conventions, each also turned by 180° about the vertical: for files without a georeference
    the heading is arbitrary.
    """
    first = replace(capture, cameras=capture.cameras[:1])
    frames = {}
    for axes in AXES:
        ahead = replace(scene, facts=replace(scene.facts, axes=axes)).turned("z up")
        back = replace(ahead, gaussians=ahead.gaussians.transformed(1.0, HALF_TURN, torch.zeros(3)))
        frames |= {axes: ahead, f"{axes}, turned": back}
    best = max(frames, key=lambda name: decibels(first.pictures(frames[name]), originals[:1]))
    return best, frames[best]
