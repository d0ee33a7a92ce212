"""Photos of the corner of a textured room, with known cameras: for the stages up to undistort, in a second or two."""

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from splatpipe.pipeline.engine.stage import Inputs, Machine
from splatpipe.pipeline.photos.files.photo_list import Photo, PhotoList, load_photo_list, save_photo_list

WIDTH, HEIGHT, FOCAL, RADIAL = 480, 360, 420.0, -0.08
ROOM_M = 3.0
TEXTURE = 640


class Recorder:
    """A Reporter that records what it receives."""

    def __init__(self) -> None:
        self.warnings: list[str] = []
        self.steps: list[tuple[float, float]] = []

    def progress(self, done: float, total: float, what: str, unit: str = "") -> None:
        self.steps.append((done, total))

    def metric(self, name: str, value: float, step: int | None = None) -> None: ...

    def note(self, message: str) -> None: ...

    def warning(self, message: str, hint: str = "") -> None:
        self.warnings.append(message)


def camera() -> pycolmap.Camera:
    """Return the true camera."""
    parameters = [FOCAL, WIDTH / 2, HEIGHT / 2, RADIAL]
    return pycolmap.Camera(camera_id=1, model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=parameters)


@cache
def texture(seed: int) -> np.ndarray:
    """Return (n, n, 3) noise of several octaves, without repetition."""
    rng = np.random.default_rng(seed)
    total = np.zeros((TEXTURE, TEXTURE, 3), np.float32)
    for cells in (10, 40, 160, 320):
        coarse = rng.normal(size=(cells, cells, 3)).astype(np.float32)
        total += cv2.resize(coarse, (TEXTURE, TEXTURE), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 34 * total, 0, 255).astype(np.float32)


def poses(count: int, step_deg: float = 9.0) -> list[np.ndarray]:
    """Return 4x4 cam_from_world of cameras on an arc that look into the corner at the origin; z is up."""
    found = []
    for number in range(count):
        angle = math.radians(20 + step_deg * number)
        centre = np.array([4.2 * math.cos(angle), 4.2 * math.sin(angle), 1.2 + 0.25 * (number % 3)])
        forward = np.array([0.6, 0.6, 0.7]) - centre
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
        pose[:3, 3] = -pose[:3, :3] @ centre
        found.append(pose)
    return found


def render(pose: np.ndarray, seed: int, lens: pycolmap.Camera | None = None) -> np.ndarray:
    """Render the (h, w, 3) photo of the planes x = 0, y = 0 and z = 0 by the true camera or another lens."""
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.ones((WIDTH * HEIGHT, 3))
    rays[:, :2] = (lens or camera()).cam_from_img(np.column_stack([x.ravel(), y.ravel()]))
    rays = rays @ pose[:3, :3]
    centre = -pose[:3, :3].T @ pose[:3, 3]
    image = np.full((HEIGHT * WIDTH, 3), 128, np.float32)
    nearest = np.full(HEIGHT * WIDTH, np.inf)
    for axis in range(3):
        depth = -centre[axis] / np.where(rays[:, axis] == 0, 1e-12, rays[:, axis])
        hit = centre + depth[:, None] * rays
        others = [other for other in range(3) if other != axis]
        place = hit[:, others] / ROOM_M * (TEXTURE - 1)
        inside = (depth > 0) & (depth < nearest) & (place >= 0).all(axis=1) & (place < TEXTURE - 1).all(axis=1)
        where = np.ascontiguousarray(place.astype(np.float32).reshape(HEIGHT, WIDTH, 2))
        seen = cv2.remap(texture(100 * seed + axis), where[..., 0], where[..., 1], cv2.INTER_LINEAR)
        image[inside] = seen.reshape(-1, 3)[inside]
        nearest[inside] = depth[inside]
    return np.rint(image).astype(np.uint8).reshape(HEIGHT, WIDTH, 3)


def list_anew(inputs: Inputs) -> None:
    """Replace `ingest`'s list by one of the photos as they are now."""
    part = inputs["ingest.photos"]
    photos = load_photo_list(part).photos
    digests = [hashlib.sha256((inputs.photos_dir / photo.name).read_bytes()).hexdigest() for photo in photos]
    listed = (replace(photo, sha256=digest) for photo, digest in zip(photos, digests, strict=True))
    save_photo_list(PhotoList(tuple(listed)), part)


def write_capture(folder: Path, pictures: dict[str, np.ndarray], masks: dict[str, np.ndarray] | None = None) -> Inputs:
    """Write photos and `ingest`'s output for them.

    Args:
        folder: Output folder.
        pictures: (h, w, 3) RGB by name; all by one camera with unknown focal length.
        masks: (h, w) by name, 0 where ignored.
    """
    part, photos_dir = folder / "part", folder / "photos"
    part.mkdir(parents=True)
    photos = []
    for name, picture in pictures.items():
        path = photos_dir / name
        path.parent.mkdir(parents=True, exist_ok=True)
        data = cv2.imencode(".png", picture[:, :, ::-1])[1].tobytes()
        path.write_bytes(data)
        mask = None
        if masks and name in masks:
            mask = f"mask{len(photos)}.png"
            (part / mask).write_bytes(cv2.imencode(".png", masks[name])[1].tobytes())
        height, width = picture.shape[:2]
        photos.append(Photo(name, hashlib.sha256(data).hexdigest(), width, height, 0, mask=mask))
    save_photo_list(PhotoList(tuple(photos)), part)
    height, width = next(iter(pictures.values())).shape[:2]
    guess = 1.2 * max(width, height)
    group = {"model": "SIMPLE_RADIAL", "width": width, "height": height, "has_prior": False}
    group["params"] = [guess, width / 2, height / 2, 0.0]
    (folder / "cameras.json").write_text(json.dumps({"cameras": [group]}))
    (folder / "positions.json").write_text(json.dumps({"positions": []}))
    parts = {"ingest.photos": part, "ingest.cameras": folder / "cameras.json"}
    (folder / "lenses.json").write_text(json.dumps({"lenses": [None]}))
    parts |= {name: folder / f"{name.split('.')[1]}.json" for name in ("ingest.positions", "ingest.lenses")}
    return Inputs(parts, photos_dir)


def with_parts(inputs: Inputs, threads: int = 1, **parts: Path) -> Inputs:
    """Return the inputs with further parts: ``features__database=…`` is the part ``features.database``."""
    more = {name.replace("__", "."): path for name, path in parts.items()}
    return Inputs({**inputs.parts, **more}, inputs.photos_dir, machine=Machine(threads=threads))


def room(names: Sequence[str], seed: int = 0, step_deg: float = 9.0) -> dict[str, np.ndarray]:
    """Return a photo for each name, along the arc."""
    return {name: render(pose, seed) for name, pose in zip(names, poses(len(names), step_deg), strict=True)}
