"""A small dataset with known truth: photos of a Gaussian model, made by our renderer, and its sparse points."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import torch

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.dataset import Split, View, load_views, split_views
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.sh import C0, rgb_to_dc
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan.lengths import PhotoSizes
from splatpipe.pipeline.train.plan.schedule import UNKNOWN, Schedule, resolve_schedule

WIDTH, HEIGHT, FOCAL = 72, 54, 70.0
CAMERAS = 9
GAUSSIANS = 150
POINT_NOISE = 0.03  # world units; the model is two units across

# No technique that is on by default: the base for tests of a single technique.
PLAIN: dict[str, object] = {
    "antialias": False,
    "background": "black",
    "sky": "off",
    "prune_free_space": 0,
    "dropout": 0.0,
    "exposure": "off",
}


def plain(**options: object) -> TrainConfig:
    """Return a training configuration without them, except for the given options."""
    return TrainConfig.model_validate(PLAIN | options)


def resolver(**density: object) -> Callable[[TrainConfig, int], Schedule]:
    """Return a replacement for ``resolve_schedule`` with other lengths and limits of density control."""

    def resolved(config: TrainConfig, footage: PhotoSizes = UNKNOWN) -> Schedule:
        schedule = resolve_schedule(config, footage)
        return replace(schedule, density=replace(schedule.density, **density))  # type: ignore[arg-type]

    return resolved


@dataclass
class Recorder:
    """A Reporter that records."""

    warnings: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    steps: list[tuple[float, float]] = field(default_factory=list)
    metrics: list[tuple[str, float, int | None]] = field(default_factory=list)

    def progress(self, done: float, total: float, what: str, unit: str = "") -> None:
        self.steps.append((done, total))

    def metric(self, name: str, value: float, step: int | None = None) -> None:
        self.metrics.append((name, value, step))

    def note(self, message: str) -> None:
        self.notes.append(message)

    def warning(self, message: str, hint: str = "") -> None:
        self.warnings.append(message)


def true_model(count: int = GAUSSIANS) -> Gaussians:
    """Return coloured blobs in a ball of radius 1 around the origin, in front of a wall of larger ones."""
    generator = torch.Generator().manual_seed(5)
    gaussians = Gaussians.empty(count, 3)
    gaussians.means = torch.randn(count, 3, generator=generator) * 0.6
    wall = count // 3
    gaussians.means[:wall] = torch.rand(wall, 3, generator=generator) * torch.tensor([5.0, 4.0, 0.2])
    gaussians.means[:wall] += torch.tensor([-2.5, -2.0, 1.5])
    gaussians.log_scales = torch.log(0.06 + 0.12 * torch.rand(count, 3, generator=generator))
    gaussians.log_scales[:wall] += 1.3
    gaussians.quats = torch.randn(count, 4, generator=generator)
    gaussians.opacity_logits = torch.full((count,), 2.0)
    gaussians.sh[:, 0] = rgb_to_dc(0.15 + 0.7 * torch.rand(count, 3, generator=generator))
    gaussians.sh[:, 1:4] = 0.15 * torch.randn(count, 3, 3, generator=generator)
    return gaussians


def cameras(count: int = CAMERAS) -> list[Camera]:
    """Return cameras on an arc of radius 4 around the origin, looking at it; some names have folders and blanks."""
    found = []
    for number, angle in enumerate(np.linspace(-0.6, 0.6, count)):
        centre = np.array([4.0 * np.sin(angle), 0.3 * np.cos(5.0 * angle), -4.0 * np.cos(angle)])
        forward = -centre / np.linalg.norm(centre)
        right = np.cross([0.0, 1.0, 0.0], forward)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack((right, np.cross(forward, right), forward))
        pose[:3, 3] = -pose[:3, :3] @ centre
        name = f"flight 1/photo_{number}.png"
        found.append(Camera(name, WIDTH, HEIGHT, FOCAL, FOCAL + 1.0, WIDTH / 2 + 1.5, HEIGHT / 2 - 1.0, pose))
    return found


def photograph(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """Render (h, w, 3) RGB, 8 bits."""
    with torch.no_grad():
        colour = rasterizer.render(gaussians, camera, rasterizer.RenderOptions(sh_degree=gaussians.sh_degree)).colour
    return (colour.clamp(0.0, 1.0) * 255.0 + 0.5).to(torch.uint8).numpy()


def write_model(folder: Path, views: list[Camera], xyz: np.ndarray, rgb: np.ndarray) -> None:
    """Write a COLMAP model with PINHOLE cameras, one per view, every point seen in every view."""
    import pycolmap  # which the bare GPU machine lacks, where other scenes are rendered

    model = pycolmap.Reconstruction()
    for number, view in enumerate(views, start=1):
        params = [view.fx, view.fy, view.cx, view.cy]
        camera = pycolmap.Camera(camera_id=number, model="PINHOLE", width=view.width, height=view.height, params=params)
        model.add_camera_with_trivial_rig(camera)
        keypoints = view.project(xyz) + 0.5
        image = pycolmap.Image(name=view.name, camera_id=number, image_id=number, keypoints=keypoints)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(view.cam_from_world[:3]))
    for index, (point, colour) in enumerate(zip(xyz, rgb, strict=True)):
        track = pycolmap.Track([pycolmap.TrackElement(number, index) for number in range(1, len(views) + 1)])
        model.add_point3D(point, track, colour)
    folder.mkdir(parents=True)
    model.write(folder)


def split_of(views: Sequence[View], every: int = 0, names: str = "") -> Split:
    """Return which of the views are trained on."""
    return split_views([view.camera.name for view in views], every, names)


def split_part(dataset: Path, every: int = 0, names: str = "") -> dict[str, Path]:
    """Write the output of `split` for a dataset to a file beside it; return it as an input part."""
    text = split_of(load_views(dataset), every, names).to_json()
    path = dataset.parent / f"split-{hashlib.sha256(text.encode()).hexdigest()[:8]}.json"
    path.write_text(text)
    return {"split.views": path}


def write_dataset(folder: Path, masked: str = "", views: list[Camera] | None = None) -> Path:
    """Write the whole dataset.

    Args:
        folder: Output folder.
        masked: Name of a photo whose left half is corrupted and masked.
        views: Cameras; the arc's if None.
    """
    truth = true_model()
    views = cameras() if views is None else views
    for view in views:
        path = folder / "images" / view.name
        path.parent.mkdir(parents=True, exist_ok=True)
        photo = photograph(truth, view)
        if view.name == masked:
            mask = np.full(photo.shape[:2], 255, np.uint8)
            mask[:, : WIDTH // 2] = 0
            photo[mask == 0] = (255, 0, 255)
            mask_path = folder / "masks" / f"{view.name}.png"
            mask_path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(mask_path), mask)
        cv2.imwrite(str(path), photo[:, :, ::-1])
    noise = np.random.default_rng(3).normal(scale=POINT_NOISE, size=(len(truth), 3))
    rgb = ((C0 * truth.sh[:, 0] + 0.5).clamp(0.0, 1.0) * 255.0).to(torch.uint8).numpy()
    write_model(folder / "sparse/0", views, truth.means.numpy().astype(np.float64) + noise, rgb)
    return folder
