"""export: the model, its cameras, the sparse points and, if asked for, the sky in the world frame; and the figures."""

from __future__ import annotations

import json
import math
import platform
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap
import torch
import trimesh

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.dataset import Points, load_points, load_views
from splatpipe.pipeline.render.rendering import as_trained, load_rendering
from splatpipe.pipeline.splat.dome import sky_dome
from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.splat.panorama import read_panorama
from splatpipe.pipeline.splat.ply import MIP_COMMENT, read_splat, write_splat
from splatpipe.pipeline.survey.crs import utm_of
from splatpipe.pipeline.survey.frames import Frame, load_frame
from splatpipe.pipeline.survey.georeference import georeference, scene_box, told_in_a_line
from splatpipe.pipeline.web.options import ExportConfig
from splatpipe.pipeline.web.viewer_scene import look_of, viewer_scene, write_viewer

Doubles = npt.NDArray[np.float64]
Facts = dict[str, Any]

FRUSTUM_PER_SPACING = 0.35  # depth of a drawn frustum over the distance to the next camera: they do not overlap
FRUSTUM_COLOUR = (255, 140, 0, 255)
GLTF_FROM_WORLD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # +Z up to glTF's +Y up
VERSIONS = ("splatpipe", "torch", "pycolmap", "opencv-contrib-python-headless", "kornia", "numpy", "pyproj")


def run(config: ExportConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write `splat.ply`, `georef.json`, `cameras.json`, `metrics.json`, `sparse.glb`, `viewer/`, and a sky if wanted.

    The frame is georef's: local east, north, up in metres where there are positions, of arbitrary scale elsewhere. The
    sky is a file of its own: within `splat.ply` it would be most of its bounding box, by which programs place and tile.
    """
    torch.set_num_threads(1)  # matrix products may round differently on more
    frame = load_frame(inputs["georef.frame"])
    dataset = inputs["undistort.dataset"]
    points = load_points(dataset)
    cameras = [view.camera for view in load_views(dataset)]

    report.progress(0, 4, "moving the model into its frame", "files")
    model = read_splat(inputs["train.model"])
    gaussians = in_world(model, frame)
    comments = ply_comments(frame, load_rendering(inputs["train.rendering"]).antialias)
    write_splat(out / "splat.ply", gaussians, comments)
    sky = read_panorama(inputs["train.sky"]) if config.sky else None
    (out / "sky").mkdir()
    if sky is not None:
        dome = sky_dome(sky, model.select(model.finite()), np.array([camera.centre() for camera in cameras]))
        write_splat(out / "sky/sky.ply", in_world(dome, frame), comments)
    elif config.sky:
        report.warning("There is no sky to hand over.", hint="It takes train.sky=model, and photos that show the sky.")
    report.progress(1, 4, "writing the cameras and the points", "files")
    _write_json(out / "cameras.json", cameras_json(cameras, frame))
    (out / "sparse.glb").write_bytes(sparse_glb(points, cameras, frame))
    centres = np.array([pose_in_world(camera, frame)[1] for camera in cameras]).reshape(-1, 3)
    box = scene_box(frame.world_from_model.apply(points.xyz), centres)
    placed = georeference(frame, box)
    _write_json(out / "georef.json", {**placed, "uncertainty": frame.residuals.get("uncertainty")})
    if frame.origin is not None:
        report.note(told_in_a_line(placed))
    report.progress(2, 4, "collecting the figures", "files")
    figures = collect_metrics(inputs, points, len(cameras), len(gaussians))
    _write_json(out / "metrics.json", figures)
    report.progress(3, 4, "writing the viewer", "files")
    write_viewer_of(inputs, gaussians, out / "viewer", config)
    report.progress(4, 4, "writing the viewer", "files")
    summary = {name: figures[name] for name in ("gaussians", "registered", "photos", "psnr", "ssim")}
    return summary if sky is None else summary | {"sky_gaussians": len(dome)}


def write_viewer_of(inputs: Inputs, gaussians: Gaussians, folder: Path, config: ExportConfig) -> None:
    """Write `viewer.html`, and `splat.spz` beside it where it is large.

    Args:
        inputs: The stage's.
        gaussians: In the world frame.
        folder: Made here; empty where no viewer is wanted or nothing can be shown.
        config: The stage's.
    """
    folder.mkdir()
    if config.viewer_megabytes == 0.0:
        return
    options, _ = as_trained(inputs["train.rendering"], gaussians)
    look = look_of(options, read_panorama(inputs["train.sky"]))
    held_out = {view["name"] for view in _read_json(inputs["evaluate.metrics"])["per_view"]}
    frame = load_frame(inputs["georef.frame"])
    scene = viewer_scene(inputs["undistort.dataset"], frame, look, held_out, len(gaussians), config.title)
    write_viewer(folder, scene, gaussians, config.viewer_megabytes * 1e6)


def in_world(gaussians: Gaussians, frame: Frame) -> Gaussians:
    """The model in the world frame: finite, its quaternions of unit length.

    Args:
        gaussians: In the model's frame.
        frame: georef's.
    """
    similarity = frame.world_from_model
    moved = gaussians.transformed(
        float(similarity.scale),
        torch.from_numpy(np.ascontiguousarray(similarity.rotation, np.float64)),
        torch.from_numpy(np.ascontiguousarray(similarity.translation, np.float64)),
    )
    length = torch.linalg.vector_norm(moved.quats, dim=1, keepdim=True)
    moved.quats = moved.quats / length.clamp(min=1e-30)
    return moved.select(moved.finite() & (length[:, 0] > 0.0))


def ply_comments(frame: Frame, antialias: bool) -> list[str]:
    """Header lines that say in which frame the splat is."""
    comments = [MIP_COMMENT] if antialias else []
    if frame.origin is None:
        return [*comments, "frame: z up, arbitrary scale and heading"]
    origin = frame.origin
    where = f"{origin.latitude:.9f} {origin.longitude:.9f} {origin.height_m:.4f}"
    return [
        *comments,
        "frame: local east north up, metres",
        f"origin: {where} (latitude longitude in degrees, WGS 84; height in metres, in the vertical datum)",
        f"vertical datum: {frame.vertical_datum}",
        f"crs: {frame.crs or utm_of(origin.latitude, origin.longitude).text} (see georef.json)",
    ]


def cameras_json(cameras: Sequence[Camera], frame: Frame) -> list[Facts]:
    """The cameras as 3DGS viewers read them: world-from-camera rotation and centre, in the splat's frame."""
    listed = []
    for index, camera in enumerate(cameras):
        rotation, centre = pose_in_world(camera, frame)
        listed.append(
            {
                "id": index,
                "img_name": camera.name,
                "width": camera.width,
                "height": camera.height,
                "position": centre.tolist(),
                "rotation": rotation.tolist(),
                "fx": camera.fx,
                "fy": camera.fy,
            }
        )
    return listed


def pose_in_world(camera: Camera, frame: Frame) -> tuple[Doubles, Doubles]:
    """A camera's world-from-camera rotation (3, 3) and centre (3,) in the world frame."""
    similarity = frame.world_from_model
    rotation = np.asarray(similarity.rotation) @ camera.cam_from_world[:3, :3].T
    return np.asarray(rotation), np.asarray(similarity.apply(camera.centre()[None])[0])


def sparse_glb(points: Points, cameras: Sequence[Camera], frame: Frame) -> bytes:
    """The sparse points and the cameras' frusta as binary glTF, world units, +Y up.

    Args:
        points: In the model's frame.
        cameras: In the model's frame.
        frame: georef's.
    """
    scene = trimesh.Scene()
    usable = np.isfinite(points.xyz).all(axis=1)
    if usable.any():
        xyz = frame.world_from_model.apply(points.xyz[usable]) @ GLTF_FROM_WORLD.T
        opaque = np.full((len(xyz), 1), 255, np.uint8)
        cloud = trimesh.PointCloud(xyz, colors=np.hstack((points.rgb[usable], opaque)))
        scene.add_geometry(cloud, geom_name="points", node_name="points")
    if cameras:
        scene.add_geometry(_frusta(cameras, frame), geom_name="cameras", node_name="cameras")
    return bytes(scene.export(file_type="glb"))


def _frusta(cameras: Sequence[Camera], frame: Frame) -> trimesh.path.Path3D:
    poses = [pose_in_world(camera, frame) for camera in cameras]
    depth = FRUSTUM_PER_SPACING * _camera_spacing(np.array([centre for _, centre in poses]))
    vertices: list[Doubles] = []
    lines: list[list[int]] = []
    for camera, (rotation, centre) in zip(cameras, poses, strict=True):
        u = (np.array([0.0, camera.width, camera.width, 0.0]) - camera.cx) / camera.fx
        v = (np.array([0.0, 0.0, camera.height, camera.height]) - camera.cy) / camera.fy
        corners = depth * np.stack((u, v, np.ones(4)), axis=1) @ rotation.T
        first = 5 * len(lines) // 2
        vertices.append(np.vstack((centre, centre + corners)) @ GLTF_FROM_WORLD.T)
        ring = [first + 1, first + 2, first + 3, first + 4, first + 1]
        lines += [ring, [first + 1, first, first + 2, first + 3, first, first + 4]]
    entities = [trimesh.path.entities.Line(line) for line in lines]
    colours = np.tile(np.array(FRUSTUM_COLOUR, np.uint8), (len(entities), 1))
    return trimesh.path.Path3D(entities, vertices=np.vstack(vertices), process=False, colors=colours)


def _camera_spacing(centres: Doubles) -> float:
    """Median distance from a camera to its nearest neighbour elsewhere, world units; 1 for a single place."""
    nearest = []
    for centre in centres:
        distance = np.linalg.norm(centres - centre, axis=1)
        nearest.append(float(np.min(distance[distance > 0.0], initial=np.inf)))
    spacing = float(np.median(nearest))
    return spacing if np.isfinite(spacing) else 1.0


def collect_metrics(inputs: Inputs, points: Points, registered: int, gaussians: int) -> Facts:
    """The run's figures, as `metrics.json` has them.

    Args:
        inputs: The stage's.
        points: The sparse model's.
        registered: Photos placed.
        gaussians: In the splat.
    """
    measured = _read_json(inputs["evaluate.metrics"])
    train = inputs.summaries.get("train", {})
    return {
        "photos": count_photos(inputs, registered),
        "registered": registered,
        "points3d": len(points.xyz),
        "mean_reprojection_error_px": mean_error(inputs["georef.model"]),
        "gaussians": gaussians,
        "iterations": train.get("iterations"),
        "planned_iterations": train.get("planned_iterations"),
        "time_budget_s": train.get("plan", {}).get("time_budget_s"),
        "train_seconds": train.get("train_seconds"),
        "train_megapixels": train.get("train_megapixels"),
        "peak_memory_bytes": train.get("peak_memory_bytes"),
        "test_views": measured["test_views"],
        **measured["mean"],
        "floaters": measured["floaters"],
        "accuracy": measured["accuracy"],
        "per_view": measured["per_view"],
        "seed": train.get("plan", {}).get("seed"),
        "device": train.get("device"),
        "versions": {name: _version(name) for name in VERSIONS} | {"python": platform.python_version()},
    }


def count_photos(inputs: Inputs, registered: int) -> int:
    """Photos that the user gave: those taken and those left out; the registered ones where the line began later."""
    count = 0
    for part, name in (("ingest.photos", "photos"), ("ingest.left_out", "left_out")):
        path = inputs.parts.get(part)
        if path is None:
            continue
        listed = _read_json(path / "photos.json" if path.is_dir() else path)
        listed = listed.get(name, []) if isinstance(listed, dict) else listed
        count += len(listed)
    return max(count, registered)


def mean_error(model: Path) -> float | None:
    """Mean reprojection error of the sparse points in the photos as they were taken, pixels; None without tracks.

    Args:
        model: The COLMAP model that training's dataset was made from.
    """
    reconstruction = pycolmap.Reconstruction(model)
    reconstruction.update_point_3d_errors()  # models made by other programs may not say
    error = float(reconstruction.compute_mean_reprojection_error())
    return round(error, 4) if math.isfinite(error) and error > 0.0 else None


def _version(distribution: str) -> str | None:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise StageError(f"{path.name} cannot be read.", hint="Run again with --rerun.") from error


def _write_json(path: Path, value: Sequence[Facts] | Mapping[str, Any]) -> None:
    path.write_text(json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")
