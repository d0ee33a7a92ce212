"""A synthetic building site: ground with two buildings, as Gaussians, with nadir and oblique photos."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import torch
from jaxtyping import Float32, Float64, Int64

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster.rasterizer import RenderOptions, render
from splatpipe.pipeline.render.rendering import render_depth
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.sh import rgb_to_dc
from splatpipe.pipeline.train.blocks.cells.photo_coverage import PhotoCoverage, photo_coverages
from splatpipe.pipeline.train.blocks.cells.visibility import Windows

LENGTH, WIDTH = 48.0, 24.0  # ground, in metres, with its corner at the origin, up is +z
SPACING = 0.25  # between Gaussians, metres
BUILDINGS = ((6.0, 6.0, 14.0, 16.0, 6.0), (30.0, 8.0, 42.0, 14.0, 4.0))  # two corners in plan, and a height
HEIGHT = 20.0  # flying height, metres
PHOTO = (160, 120)
FOCAL = 130.0
OPTIONS = RenderOptions(sh_degree=0, near=0.1)


def surface() -> Float64[np.ndarray, "n 3"]:
    """Return points on ground, roofs and walls, evenly spaced."""
    x, y = np.meshgrid(np.arange(SPACING / 2, LENGTH, SPACING), np.arange(SPACING / 2, WIDTH, SPACING))
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    parts = []
    for x0, y0, x1, y1, top in BUILDINGS:
        under = (points[:, 0] > x0) & (points[:, 0] < x1) & (points[:, 1] > y0) & (points[:, 1] < y1)
        points[under, 2] = top
        heights = np.arange(SPACING / 2, top, SPACING)
        for start, end in (((x0, y0), (x1, y0)), ((x1, y0), (x1, y1)), ((x1, y1), (x0, y1)), ((x0, y1), (x0, y0))):
            steps = np.arange(SPACING / 2, math.dist(start, end), SPACING) / math.dist(start, end)
            along = np.array(start) + steps[:, None] * (np.array(end) - start)
            parts.append(np.column_stack([np.repeat(along, len(heights), 0), np.tile(heights, len(along))]))
    return np.concatenate([points, *parts])


def model(xyz: Float64[np.ndarray, "n 3"]) -> Gaussians:
    """Create opaque, round, grey Gaussians at points, with a texture by position."""
    found = Gaussians.empty(len(xyz), 0)
    found.means = torch.from_numpy(xyz).float()
    found.log_scales = torch.full((len(xyz), 3), math.log(0.6 * SPACING))
    found.opacity_logits = torch.full((len(xyz),), 4.0)
    texture = 0.5 + 0.1 * np.sin(xyz @ [2.1, 1.3, 1.7]) + 0.1 * np.sin(xyz @ [-0.9, 2.7, 0.8])
    found.sh[:, 0] = rgb_to_dc(torch.from_numpy(texture).float()[:, None].expand(-1, 3))
    return found


def camera(name: str, centre: Float64[np.ndarray, " 3"], forward: Float64[np.ndarray, " 3"]) -> Camera:
    """Return a camera without roll; one that looks straight down has its top to the north."""
    forward = forward / np.linalg.norm(forward)
    aside = np.array([0.0, 1.0, 0.0]) if abs(forward[2]) > 0.999 else np.array([0.0, 0.0, 1.0])
    right = np.cross(forward, aside)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ centre
    return Camera(name, *PHOTO, FOCAL, FOCAL, PHOTO[0] / 2, PHOTO[1] / 2, pose)


def flight() -> list[Camera]:
    """Return cameras in nadir strips, and oblique ones from the south and the north."""
    found = []
    for x in np.arange(4.0, LENGTH, 8.0):
        places = [np.array([x, y, HEIGHT]) for y in np.arange(4.0, WIDTH, 8.0)]
        found += [camera(f"nadir_{x:.0f}_{place[1]:.0f}", place, np.array([0.0, 0.0, -1.0])) for place in places]
        for side, y in ((1.0, -12.0), (-1.0, WIDTH + 12.0)):
            found.append(camera(f"oblique_{x:.0f}_{side:.0f}", np.array([x, y, HEIGHT]), np.array([0.0, side, -1.0])))
    return found


def observed(
    xyz: Float64[np.ndarray, "n 3"], cameras: list[Camera], coarse: Gaussians
) -> list[Int64[np.ndarray, " _"]]:
    """Return the points that each camera sees: at most half a metre behind the rendered depth."""
    found = []
    for view in cameras:
        rows, pixels, depths = view.in_view(xyz)
        columns, lines = pixels.astype(int).T
        rendered_depth = render_depth(coarse, view, OPTIONS)[lines, columns]
        found.append(rows[depths < rendered_depth + 0.5])
    return found


def depth_of(coarse: Gaussians, grid: Camera) -> Float32[np.ndarray, "h w"]:
    """Return the coarse model's depth."""
    return render_depth(coarse, grid, OPTIONS)


def quarters(view: Camera) -> Windows:
    """Cut a photo into two rows and two columns."""
    x, y = (0, view.width // 2, view.width), (0, view.height // 2, view.height)
    return np.array([[x[i], y[j], x[i + 1], y[j + 1]] for j in (0, 1) for i in (0, 1)])


def site_coverages(coarse: Gaussians, points: Float64[np.ndarray, "p 3"], by_depth: bool = True) -> list[PhotoCoverage]:
    """Return what the flight sees, by the coarse model's depth or by points alone."""
    cameras = flight()
    rows = observed(points, cameras, coarse)
    return photo_coverages(cameras, rows, (lambda grid: depth_of(coarse, grid)) if by_depth else None)


def write_dataset(folder: Path) -> Path:
    """Write the flight as a dataset: photos of the model, its cameras, and every seventh point as a sparse one."""
    everything = surface()
    truth = model(everything)
    cameras, xyz = flight(), everything[::7].copy()
    rows = observed(xyz, cameras, truth)
    found = pycolmap.Reconstruction()
    tracks: dict[int, list[pycolmap.TrackElement]] = {}
    for number, (view, seen) in enumerate(zip(cameras, rows, strict=True), start=1):
        path = folder / "images" / f"{view.name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        with torch.no_grad():
            colour = render(truth, view, OPTIONS).colour
        cv2.imwrite(str(path), (colour.clamp(0.0, 1.0) * 255.0 + 0.5).to(torch.uint8).numpy()[:, :, ::-1])
        lens = [view.fx, view.fy, view.cx, view.cy]
        found.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=number, model="PINHOLE", width=view.width, height=view.height, params=lens)
        )
        keypoints = view.project(xyz[seen]) + 0.5
        photo = pycolmap.Image(name=f"{view.name}.png", camera_id=number, image_id=number, keypoints=keypoints)
        found.add_image_with_trivial_frame(photo, pycolmap.Rigid3d(view.cam_from_world[:3]))
        for at, row in enumerate(seen.tolist()):
            tracks.setdefault(row, []).append(pycolmap.TrackElement(number, at))
    for row, elements in sorted(tracks.items()):
        if len(elements) > 1:
            found.add_point3D(xyz[row], pycolmap.Track(elements), np.array([128, 128, 128], np.uint8))
    (folder / "sparse/0").mkdir(parents=True)
    found.write(folder / "sparse/0")
    return folder
