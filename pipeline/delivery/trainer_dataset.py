"""A run's photos and cameras for other trainers, in the world frame: COLMAP's layout, nerfstudio's `transforms.json`.

Both lie in one folder and share its `images/`: undistorted photos, as used in this run's training.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from splatpipe.pipeline.delivery.delivery_frame import pose_in_world
from splatpipe.pipeline.engine.files.json_file import write_json
from splatpipe.pipeline.engine.files.output_file import write_file
from splatpipe.pipeline.photos.colmap.colmap_reconstruction import read_reconstruction
from splatpipe.pipeline.photos.pixels.dataset import IMAGES, MASKS, MODEL, Points, View, load_points, load_views
from splatpipe.pipeline.survey.crs.frames import Frame

SPARSE_PLY = "sparse_pc.ply"  # nerfstudio's name for it
_GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])  # a camera that looks along −z, y up, from one along z, y down


def write_colmap(dataset: Path, frame: Frame, folder: Path) -> None:
    """Write `images/`, `masks/` and `sparse/0`, whose cameras are PINHOLE.

    Args:
        dataset: The folder that `undistort` wrote.
        frame: georef's.
        folder: Output folder.

    Raises:
        OSError: if it cannot be written.
        SplatpipeError: if the dataset's model is broken.
    """
    model = read_reconstruction(dataset / MODEL)
    similarity = frame.world_from_model
    model.transform(
        pycolmap.Sim3d(float(similarity.scale), pycolmap.Rotation3d(similarity.rotation), similarity.translation)
    )
    (folder / MODEL).mkdir(parents=True, exist_ok=True)
    model.write(folder / MODEL)
    _add_pictures(dataset, folder)


def write_transforms(dataset: Path, frame: Frame, held_out: Collection[str], folder: Path) -> None:
    """Write `images/`, `masks/`, `transforms.json` and the sparse points as `sparse_pc.ply`.

    Args:
        dataset: The folder that `undistort` wrote.
        frame: georef's.
        held_out: Names of the photos that were not trained on.
        folder: Output folder.

    Raises:
        OSError: if it cannot be written.
    """
    views, points = load_views(dataset), load_points(dataset)
    folder.mkdir(parents=True, exist_ok=True)
    train, test = (
        [f"{IMAGES}/{view.camera.name}" for view in views if (view.camera.name in held_out) == out]
        for out in (False, True)
    )
    table: dict[str, Any] = {
        "camera_model": "PINHOLE",
        "orientation_override": "none",
        "applied_transform": np.eye(4)[:3].tolist(),
        "ply_file_path": SPARSE_PLY,
        "train_filenames": train,
        "val_filenames": test,
        "test_filenames": test,
        "frames": [_frame_of(view, frame) for view in views],
    }
    write_json(folder / "transforms.json", table)
    write_points_ply(folder / SPARSE_PLY, points, frame)
    _add_pictures(dataset, folder)


def _frame_of(view: View, frame: Frame) -> Mapping[str, Any]:
    camera, name = view.camera, view.camera.name
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = pose_in_world(camera, frame)
    mask = {} if view.mask_path is None else {"mask_path": f"{MASKS}/{name}.png"}
    return {
        "file_path": f"{IMAGES}/{name}",
        **mask,
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "transform_matrix": (pose @ _GL_FROM_CV).tolist(),
    }


def write_points_ply(path: Path, points: Points, frame: Frame) -> None:
    """Write the sparse points as 3DGS trainers' `input.ply`: positions, normals of zero, colours.

    Args:
        path: The file; replaced if it is there.
        points: In the model's frame.
        frame: georef's.
    """
    usable = np.isfinite(points.xyz).all(axis=1)
    floats, bytes_ = ("x", "y", "z", "nx", "ny", "nz"), ("red", "green", "blue")
    kinds = [*((name, "<f4") for name in floats), *((name, "u1") for name in bytes_)]
    rows = np.zeros(int(usable.sum()), kinds)
    xyz = frame.world_from_model.apply(points.xyz[usable])
    for axis, name in enumerate("xyz"):
        rows[name] = xyz[:, axis]
    for band, name in enumerate(bytes_):
        rows[name] = points.rgb[usable, band]
    names = [*(f"property float {name}" for name in floats), *(f"property uchar {name}" for name in bytes_)]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}", *names, "end_header", ""]
    write_file(path, "\n".join(head).encode("ascii") + rows.tobytes())


def _add_pictures(dataset: Path, folder: Path) -> None:
    """Hard-link photos and masks where the disk allows it: the run's own files are never rewritten."""
    for part in (IMAGES, MASKS):
        for source in sorted(path for path in (dataset / part).rglob("*") if path.is_file()):
            target = folder / source.relative_to(dataset)
            if target.exists():
                continue
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                os.link(source, target)
            except OSError:
                shutil.copy2(source, target)
