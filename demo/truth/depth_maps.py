"""Ground-truth depth maps of the capture's photos: ``python -m splatpipe.demo.truth.depth_maps OUT [--noise]``.

They serve to test surface reconstruction apart from depth estimation: the true depth along the ray of every pixel's
centre, beside the photo of the pinhole camera. With ``--noise`` they have errors like measured ones. Each photo's
file ``NAME.npz`` holds ``depth`` (float32, metres along z, 0 where there is none), ``confidence`` (uint8, number of
other photos that see the same place), ``name``, ``width``, ``height``, ``fx``, ``fy``, ``cx``, ``cy`` and
``cam_from_world`` (4 × 4; local east, north, up in metres); ``NAME.png`` beside it is the photo.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from jaxtyping import Bool, Float32, Float64, UInt8
from PIL import Image

from splatpipe.demo import capture_path
from splatpipe.demo.photography.cameras import BrownLens
from splatpipe.demo.truth.truth import depth_map, true_poses, true_surface
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.resampling import resample
from splatpipe.pipeline.photos.pixels.undistortion import pinhole_camera

SEED = 20261123
BLOCK = 4  # pixels a side that share a confidence
SAME_DEPTH = 0.002  # relative: a larger difference means that the other photo sees something else there
PARALLAX_PX = 0.3  # standard deviation of the noise
BASELINE_RANK = 4  # rank by distance of the neighbouring photo whose baseline defines the parallax
NOISE_REACH_PX = 1.5  # sigma of the noise's correlation, as matching windows of some 7 pixels produce it
HOLES, HOLE_REACH_PX = 0.10, 6.0
OUTLIERS, OUTLIER_REACH_PX = 0.02, 2.0
OUTLIER_SHARE = (0.6, 1.6)  # an outlier's depth over the true depth, from and to
CONFIRMED = 0.7  # share of the photos that see a place which confirm a noisy depth
UNLIMITED_MEGAPIXELS = 1e6


def true_cameras(lens: BrownLens | None = None) -> tuple[pycolmap.Camera, list[Camera]]:
    """The capture's lens, and its photos' pinhole cameras, in name order, as ``undistort`` would choose them."""
    source = pycolmap.Camera(camera_id=1, **(lens or BrownLens()).colmap())
    target = pinhole_camera(source, UNLIMITED_MEGAPIXELS, 1)
    focal, middle = (target.focal_length_x, target.focal_length_y), (target.principal_point_x, target.principal_point_y)
    poses = sorted(true_poses().items())
    return source, [Camera(name, target.width, target.height, *focal, *middle, pose) for name, pose in poses]


def confirmations(
    cameras: Sequence[Camera], depths: Sequence[Float32[np.ndarray, "h w"]], number: int
) -> UInt8[np.ndarray, "h w"]:
    """Number of other photos that see the place at each pixel, sampled at one pixel per block.

    Args:
        cameras: Of all photos, of one size.
        depths: Their depth maps, metres, 0 where there is nothing.
        number: Index of the photo.
    """
    here, own = cameras[number], depths[number]
    y, x = np.mgrid[BLOCK // 2 : here.height : BLOCK, BLOCK // 2 : here.width : BLOCK]
    points = here.unproject(np.stack([x.ravel(), y.ravel()], axis=1) + 0.5, own[y, x].ravel().astype(np.float64))
    count = np.zeros(x.size, np.uint8)
    for k, (camera, depth) in enumerate(zip(cameras, depths, strict=True)):
        if k != number:
            rows, pixels, expected = camera.in_view(points)
            column, row = pixels.astype(np.intp).T
            count[rows] += np.abs(depth[row, column] - expected) <= SAME_DEPTH * expected
    whole = cv2.resize(count.reshape(x.shape), (here.width, here.height), interpolation=cv2.INTER_NEAREST)
    return np.where(own > 0.0, whole, 0).astype(np.uint8)


def noisy(
    camera: Camera,
    depth: Float32[np.ndarray, "h w"],
    confidence: UInt8[np.ndarray, "h w"],
    baseline_m: float,
    rng: np.random.Generator,
) -> tuple[Float32[np.ndarray, "h w"], UInt8[np.ndarray, "h w"]]:
    """Add errors to a depth map: correlated parallax noise, patches without depth, patches of outliers.

    Args:
        camera: Of the map.
        depth: True depth, metres, 0 where there is nothing.
        confidence: True confidence.
        baseline_m: Distance to the photo that defines the parallax.
        rng: Random numbers of this map.
    """
    error = _field(depth.shape, NOISE_REACH_PX, rng) * PARALLAX_PX
    share = np.clip(1.0 + error * depth / (camera.fx * baseline_m), 0.5, 2.0)  # dz = z² dx / (f b)
    found = depth * share.astype(np.float32)
    wild = _patches(depth.shape, OUTLIERS, OUTLIER_REACH_PX, rng)
    low, high = OUTLIER_SHARE
    found[wild] = depth[wild] * rng.uniform(low, high, int(wild.sum()))
    found[_patches(depth.shape, HOLES, HOLE_REACH_PX, rng)] = 0.0
    confirmed = rng.binomial(confidence, CONFIRMED)
    confirmed[wild] = rng.integers(0, 3, int(wild.sum()))
    return found, np.where(found > 0.0, confirmed, 0).astype(np.uint8)


def _field(shape: tuple[int, ...], reach_px: float, rng: np.random.Generator) -> Float64[np.ndarray, "h w"]:
    """Normal noise of mean 0 and standard deviation 1, correlated over a reach."""
    field = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), reach_px)
    return np.asarray(field / field.std())


def _patches(
    shape: tuple[int, ...], share: float, reach_px: float, rng: np.random.Generator
) -> Bool[np.ndarray, "h w"]:
    """Random patches that cover a share of an image."""
    field = _field(shape, reach_px, rng)
    return np.asarray(field > np.quantile(field, 1.0 - share))


def save(path: Path, camera: Camera, depth: Float32[np.ndarray, "h w"], confidence: UInt8[np.ndarray, "h w"]) -> None:
    """Write a map's file."""
    fields = {key: getattr(camera, key) for key in ("name", "width", "height", "fx", "fy", "cx", "cy")}
    np.savez(path, depth=depth, confidence=confidence, cam_from_world=camera.cam_from_world, **fields)


def load(path: Path) -> tuple[Camera, Float32[np.ndarray, "h w"], UInt8[np.ndarray, "h w"]]:
    """Read a map's file: the camera, the depths, the confidence."""
    with np.load(path) as held:
        numbers: dict[str, Any] = {key: held[key].item() for key in ("name", "width", "height", "fx", "fy", "cx", "cy")}
        return Camera(**numbers, cam_from_world=held["cam_from_world"]), held["depth"], held["confidence"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="folder for the maps and the photos")
    parser.add_argument("--noise", type=Path, help="another folder, for the same maps with errors")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    source, cameras = true_cameras()
    target = pycolmap.Camera(
        model="PINHOLE",
        width=cameras[0].width,
        height=cameras[0].height,
        params=[cameras[0].fx, cameras[0].fy, cameras[0].cx, cameras[0].cy],
    )
    surface, depths = true_surface(), []
    for camera in cameras:
        depth = depth_map(camera, surface)
        depths.append(np.where(np.isfinite(depth), depth, 0.0).astype(np.float32))
        picture = arguments.out / f"{Path(camera.name).stem}.png"
        if not picture.exists():
            photo = np.asarray(Image.open(capture_path() / camera.name).convert("RGB"))
            Image.fromarray(resample(photo, source, target)).save(picture)
    centres = np.stack([camera.centre() for camera in cameras])
    for number, (camera, depth) in enumerate(zip(cameras, depths, strict=True)):
        confidence = confirmations(cameras, depths, number)
        save(arguments.out / f"{Path(camera.name).stem}.npz", camera, depth, confidence)
        if arguments.noise:
            arguments.noise.mkdir(parents=True, exist_ok=True)
            baseline = float(np.sort(np.linalg.norm(centres - centres[number], axis=1))[BASELINE_RANK])
            erring = noisy(camera, depth, confidence, baseline, np.random.default_rng((SEED, number)))
            save(arguments.noise / f"{Path(camera.name).stem}.npz", camera, *erring)
        print(f"{camera.name}: {number + 1} of {len(cameras)}", flush=True)


if __name__ == "__main__":
    main()
