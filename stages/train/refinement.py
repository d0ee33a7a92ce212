"""What a fraction of a pixel SfM left in the cameras, learnt along and anchored to it.

That photos correct the cameras that they are learnt with: Lin et al., "BARF: Bundle-Adjusting Neural Radiance Fields",
ICCV 2021; for Gaussians, with the pose's gradient in closed form: Matsuki et al., "Gaussian Splatting SLAM", CVPR 2024.
What keeps them where they were is from photogrammetry:

- Motions are counted in pixels: a turn, a shift at the median depth of the photo's sparse points, or another focal
  length of size 1 moves its picture by about a pixel. So one learning rate, decay and limit does for all of them.
- Free network adjustment (Triggs et al., "Bundle Adjustment - A Modern Synthesis", 1999): the cameras together are not
  moved, turned or scaled. Of seven numbers that no photo can tell, the least-squares fit to SfM's cameras is kept at
  the identity, so the frame, and a georeference with it, stays the deliverable's.
- Each photo is drawn back to SfM by a decay, and never farther from it than a limit.

Cameras that share their intrinsics share their focal length. Photos held out are not in here: they are evaluated with
SfM's cameras, so that what is measured does not profit from a fit to them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from splatpipe.pipeline.raster.optim import Adam
from splatpipe.pipeline.scene.camera import Camera
from splatpipe.pipeline.scene.dataset import View, load_points_and_tracks
from splatpipe.pipeline.scene.images import reduced_camera
from splatpipe.stages.options import TrainConfig
from splatpipe.stages.train.plan import Plan
from splatpipe.stages.train.side import SideModel
from splatpipe.stages.train.stream import TrainingPhoto

FIRST_SHARE = 0.2  # of the run, in which the Gaussians find their places among SfM's cameras
LAST_RATE = 0.1  # of the first; exponential in between
LIMIT_PX = 2.0  # of a photo's motion: what is farther off was placed wrongly, which is not for training to mend
BETAS = (0.9, 0.99)  # a photo has some dozens of steps: by 0.999 its gradients' size would always be underestimated
DRIFT_GRID = 5  # places along each side of a picture at which its motion is measured
DEPENDENT = 1e-9  # of a direction's length: what is left of it is rounding
_NAME = "shifts"


@dataclass(frozen=True, eq=False)
class Anchor:
    """SfM's cameras, and what a motion of theirs is in pixels.

    Attributes:
        cameras: Of the photos trained on, at the full size of training, by name.
        depths: Median depth of each one's sparse points, world units.
        units: Of ``Camera.moved``'s motion, a pixel.
        gauge: Orthonormal motions, in pixels, that turn, shift and scale all cameras together.
        group: Number of the physical camera.
    """

    cameras: tuple[Camera, ...]
    depths: Float64[np.ndarray, " n"]
    units: Float64[np.ndarray, "n 7"]
    gauge: tuple[Float64[Tensor, "n 6"], ...]
    group: Int64[Tensor, " n"]


class CameraRefinement(SideModel):
    """A small motion of each photo's camera.

    Args:
        names: Of the photos trained on.

    Attributes:
        anchor: Not in the checkpoint; without it, no camera moves.
    """

    def __init__(self, names: Sequence[str]) -> None:
        super().__init__({_NAME: torch.zeros(len(names), 7)})
        self.adam = Adam(self.tensors, betas=BETAS)
        self._row = {name: row for row, name in enumerate(sorted(names))}
        self.anchor: Anchor | None = None

    def motion_of(self, name: str) -> Float64[np.ndarray, " 7"]:
        """How a photo's camera is moved now, as ``Camera.moved`` takes it."""
        assert self.anchor is not None
        row = self._row[name]
        return np.asarray(self.tensors[_NAME].detach()[row].double().numpy() * self.anchor.units[row])

    def refined(self, photo: TrainingPhoto, iteration: int, options: TrainConfig) -> TrainingPhoto:
        """A photo with its camera as it is now, and a probe for the camera's gradient; the photo itself at first."""
        if self.anchor is None or iteration <= FIRST_SHARE * options.iterations:
            return photo
        camera = photo.camera.moved(self.motion_of(photo.camera.name))
        return replace(photo, camera=camera, camera_probe=torch.zeros(7, requires_grad=True))

    def step(self, photo: TrainingPhoto, iteration: int, options: TrainConfig) -> None:
        """Step a photo's camera against its probe's gradient, and keep all of them where the anchor wants them.

        The gradient is by a motion after the present one; to thousandths of it, that adds up.

        Args:
            photo: From ``refined``; without a gradient, nothing happens.
            iteration: From 1.
            options: Resolved.
        """
        if self.anchor is None or photo.camera_probe is None or photo.camera_probe.grad is None:
            return
        shifts = self.tensors[_NAME]
        row = self._row[photo.camera.name]
        gradient = photo.camera_probe.grad.double() * torch.from_numpy(self.anchor.units[row])
        if options.refine_cameras != "pose_focal":
            gradient[6] = 0.0
        rows = torch.zeros(len(shifts), dtype=torch.bool)
        rows[row] = True
        shifts.grad = torch.zeros_like(shifts)
        shifts.grad[row] = gradient.float() + options.refine_decay * shifts.detach()[row]
        share = min(1.0, iteration / options.iterations)
        self.descend({_NAME: options.lr_cameras * math.exp(math.log(LAST_RATE) * share)}, rows)
        with torch.no_grad():
            shifts.copy_(_anchored(shifts.double(), self.anchor))

    def drifts(self) -> dict[str, dict[str, Any]]:
        """How far each photo's camera is from SfM's, by name."""
        assert self.anchor is not None
        found = {}
        for name, row in self._row.items():
            camera, motion = self.anchor.cameras[row], self.motion_of(name)
            found[name] = {
                "shift_px": image_shift_px(camera, motion, float(self.anchor.depths[row])),
                "rotation_deg": math.degrees(math.sqrt(float((motion[:3] ** 2).sum()))),
                "translation": math.sqrt(float((motion[3:6] ** 2).sum())),
                "focal_factor": math.exp(motion[6]),
                "cam_from_world": camera.moved(motion).cam_from_world[:3].tolist(),
            }
        return found

    def summary(self) -> dict[str, float]:
        """The drift in two figures, pixels."""
        shifts = [drift["shift_px"] for drift in self.drifts().values()]
        return {
            "camera_shift_median_px": round(float(np.median(shifts)), 3),
            "camera_shift_max_px": round(max(shifts), 3),
        }


def anchor(refinement: CameraRefinement | None, plan: Plan, views: Sequence[View], dataset: Path) -> None:
    """Hold a refinement to SfM's cameras, arguments as of ``anchor_of``; nothing where there is none."""
    if refinement is not None:
        refinement.anchor = anchor_of(plan, views, dataset)


def anchor_of(plan: Plan, views: Sequence[View], dataset: Path) -> Anchor:
    """What a training's cameras are held to.

    Args:
        plan: The training's.
        views: Those it trains on.
        dataset: Theirs, with the sparse points.

    Raises:
        StageError: if the dataset is broken.
    """
    views = sorted(views, key=lambda view: view.camera.name)
    cameras = tuple(reduced_camera(view.camera, plan.megapixels) for view in views)
    points, tracks = load_points_and_tracks(dataset)
    depths = _median_depths(cameras, [points.xyz[tracks[camera.name]] for camera in cameras], plan.extent)
    focals = np.array([math.sqrt(camera.fx * camera.fy) for camera in cameras])
    # Root mean square distance of a picture's pixels from its middle: what turning about the view axis moves them by.
    radii = np.array([math.hypot(camera.width, camera.height) / math.sqrt(12.0) for camera in cameras])
    turn, shift = 1.0 / focals, depths / focals
    units = np.stack([turn, turn, 1.0 / radii, shift, shift, depths / radii, 1.0 / radii], axis=1)
    lenses = [(c.width, c.height, c.fx, c.fy, c.cx, c.cy) for c in (view.camera for view in views)]
    numbers = {lens: number for number, lens in enumerate(dict.fromkeys(lenses))}
    group = torch.tensor([numbers[lens] for lens in lenses])
    return Anchor(cameras, depths, units, _gauge(cameras, units[:, :6]), group)


def _median_depths(
    cameras: Sequence[Camera], points: Sequence[Float64[np.ndarray, "_ 3"]], otherwise: float
) -> Float64[np.ndarray, " n"]:
    """Of the points that each camera sees; where it sees none, as deep as for the others."""
    depths = []
    for camera, xyz in zip(cameras, points, strict=True):
        z = xyz @ camera.cam_from_world[2, :3] + camera.cam_from_world[2, 3]
        depths.append(float(np.median(z[z > 0.0])) if (z > 0.0).any() else math.nan)
    found = np.array(depths)
    known = found[np.isfinite(found)]
    return np.where(np.isfinite(found), found, np.median(known) if len(known) else otherwise)


def _gauge(cameras: Sequence[Camera], units: Float64[np.ndarray, "n 6"]) -> tuple[Float64[Tensor, "n 6"], ...]:
    """Orthonormal directions of the motions that all cameras make together, in their own frames and in pixels.

    Without LAPACK, whose last bits may depend on where its arguments lie in memory.
    """
    centres = np.stack([camera.centre() for camera in cameras])
    offsets = centres - centres.mean(axis=0)
    rotations = np.stack([camera.cam_from_world[:3, :3] for camera in cameras])
    directions = []
    for axis in np.eye(3):
        zero = np.zeros_like(offsets)
        turned = np.broadcast_to(axis, offsets.shape), np.cross(axis, offsets)
        directions += [turned, (zero, np.broadcast_to(axis, offsets.shape))]
    directions.append((np.zeros_like(offsets), offsets))
    basis: list[Tensor] = []
    for turn, move in directions:
        own = -np.concatenate([(rotations * v[:, None, :]).sum(axis=2) for v in (turn, move)], axis=1) / units
        rest = torch.from_numpy(own)
        length = rest.square().sum().sqrt()
        for _ in range(2):  # Gram-Schmidt, repeated against rounding
            for known in basis:
                rest = rest - (known * rest).sum() * known
        left = rest.square().sum().sqrt()
        if left > DEPENDENT * length:  # a single camera cannot be scaled
            basis.append(rest / left)
    return tuple(basis)


def _anchored(shifts: Float64[Tensor, "n 7"], anchor: Anchor) -> Float64[Tensor, "n 7"]:
    """The motions within the limit, without any that all cameras make together, focal lengths shared; in pixels."""
    shifts = shifts * (LIMIT_PX / shifts.square().sum(dim=1, keepdim=True).sqrt()).clamp(max=1.0)
    poses = shifts[:, :6]
    for direction in anchor.gauge:
        poses = poses - (direction * poses).sum() * direction
    count = int(anchor.group.max()) + 1
    members = torch.zeros(count, dtype=torch.float64).index_add(0, anchor.group, torch.ones_like(shifts[:, 6]))
    focal = torch.zeros(count, dtype=torch.float64).index_add(0, anchor.group, shifts[:, 6]) / members
    shifts = torch.cat([poses, focal[anchor.group, None]], dim=1)
    # One beyond the limit by what the others took back: all give in a little, which keeps their common motion zero.
    largest = float(shifts.square().sum(dim=1).max().sqrt())
    return shifts if largest <= LIMIT_PX else shifts * (LIMIT_PX / largest)


def image_shift_px(camera: Camera, motion: Float64[np.ndarray, " 7"], depth: float) -> float:
    """How far a motion moves the picture: the mean over a grid of pixels, for what lies at one depth.

    Args:
        camera: Before it.
        motion: As ``Camera.moved`` takes it.
        depth: Along the view axis, world units.
    """
    shares = (np.arange(DRIFT_GRID) + 0.5) / DRIFT_GRID
    x, y = np.meshgrid(shares * camera.width, shares * camera.height)
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    rays = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    points = depth * np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    moved = replace(camera, cam_from_world=np.eye(4)).moved(motion).project(points)
    return float(np.sqrt(((moved - pixels) ** 2).sum(axis=1)).mean())


def refined_json(refinement: CameraRefinement | None, options: TrainConfig) -> str:
    """The text of `cameras_refined.json`: pixels of the training's size, world units of the dataset's frame."""
    fields: dict[str, Any] = {"model": options.refine_cameras, "photos": {}}
    if refinement is not None:
        fields |= refinement.summary() | {"photos": refinement.drifts()}
    return json.dumps(fields, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
