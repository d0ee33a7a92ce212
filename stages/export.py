"""export: the model, its cameras, the sparse points and, if requested, the sky in the world frame; and the metrics."""

from __future__ import annotations

import math
import platform
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch

from splatpipe.pipeline.delivery.delivery_frame import (
    bounded_comments,
    cameras_json,
    facts_of,
    georef_facts,
    in_world,
    inside_first,
    pose_in_world,
)
from splatpipe.pipeline.delivery.sparse_scene import sparse_glb
from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.engine.files.json_file import read_json, write_json
from splatpipe.pipeline.engine.files.output_file import write_file
from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.geometry.plan_area import read_world_area
from splatpipe.pipeline.photos.colmap.colmap_reconstruction import read_reconstruction
from splatpipe.pipeline.photos.pixels.dataset import Points, load_points, load_views
from splatpipe.pipeline.render.rendering import as_trained, load_rendering
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.splat.formats import plain_ply
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.scene import Scene
from splatpipe.pipeline.splat.sky.dome import sky_dome
from splatpipe.pipeline.splat.sky.panorama import read_panorama
from splatpipe.pipeline.survey.crs.frames import load_frame
from splatpipe.pipeline.survey.crs.georeference import accuracy_line, scene_box
from splatpipe.pipeline.web.deliverables import RunSplat, write_deliverables
from splatpipe.pipeline.web.options import ExportConfig, parse_formats
from splatpipe.pipeline.web.viewer import ViewerScene
from splatpipe.pipeline.web.viewer_scene import viewer_rendering, viewer_scene, write_viewer

Facts = dict[str, Any]

VERSIONS = ("splatpipe", "torch", "pycolmap", "opencv-contrib-python-headless", "kornia", "numpy", "pyproj")


def run(config: ExportConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write `splat.ply`, `georef.json`, `cameras.json`, `metrics.json`, `sparse.glb`, `viewer/`; optionally `sky/` and
    `formats/`.

    The frame is georef's: local east, north, up in metres if it could be georeferenced, otherwise of arbitrary scale.
    The sky is a separate file: in `splat.ply` it would dominate the bounding box, which programs use for placing and
    tiling.
    """
    torch.set_num_threads(1)  # matrix products may round differently on more threads
    frame = load_frame(inputs["georef.frame"])
    dataset = inputs["undistort.dataset"]
    points = load_points(dataset)
    cameras = [view.camera for view in load_views(dataset)]

    report.progress(0, 4, "moving the model into its frame", "files")
    model = read_splat(inputs["clean.model"])
    facts = facts_of(frame, load_rendering(inputs["train.rendering"]).antialias)
    area = read_world_area(inputs.parts.get("georef.boundary"))
    sky = read_panorama(inputs["train.sky"]) if config.sky else None
    (out / "sky").mkdir()
    if sky is not None:
        dome = sky_dome(sky, model.select(model.finite()), np.array([camera.centre() for camera in cameras]))
        plain_ply.write(out / "sky/sky.ply", Scene(in_world(dome, frame), facts))
    elif config.sky:
        report.warning("There is no sky to export.", hint="It needs train.sky=model, and photos that show the sky.")
    gaussians, within = inside_first(in_world(model, frame), area)
    del model  # free its memory: `gaussians` is as large
    bounded = bounded_comments(within, len(gaussians))
    plain_ply.write(out / "splat.ply", Scene(gaussians, facts), bounded)
    report.progress(1, 4, "writing the cameras and the points", "files")
    write_json(out / "cameras.json", cameras_json(cameras, frame))
    write_file(out / "sparse.glb", sparse_glb(points, cameras, frame))
    centres = np.array([pose_in_world(camera, frame)[1] for camera in cameras]).reshape(-1, 3)
    box = scene_box(frame.world_from_model.apply(points.xyz), centres)
    placed = georef_facts(frame, box, inputs.parts.get("georef.boundary"))
    write_json(out / "georef.json", placed)
    if frame.origin is not None:
        report.note(accuracy_line(placed))
    report.progress(2, 4, "collecting the figures", "files")
    figures = collect_metrics(inputs, points, len(cameras), len(gaussians))
    figures |= {} if within is None else {"gaussians_inside": within}
    write_json(out / "metrics.json", figures)
    report.progress(3, 4, "writing the viewer", "files")
    (out / "viewer").mkdir()
    (out / "formats").mkdir()
    sizes: dict[str, int] = {}
    if config.viewer_megabytes > 0.0 or config.formats:
        viewer = viewer_of(inputs, gaussians, config.title)
        if config.viewer_megabytes > 0.0:
            write_viewer(out / "viewer", viewer, gaussians, config.viewer_megabytes * 1e6)
        run = RunSplat(Scene(gaussians, facts), frame, dataset, cameras, points, held_out_names(inputs), placed, viewer)
        sizes = write_deliverables(parse_formats(config.formats), run, out / "formats", report)
    report.progress(4, 4, "writing the viewer", "files")
    summary: dict[str, Any] = {name: figures[name] for name in ("gaussians", "registered", "photos", "psnr", "ssim")}
    summary |= {"formats": sizes} if sizes else {}
    return summary if sky is None else summary | {"sky_gaussians": len(dome)}


def viewer_of(inputs: Inputs, gaussians: Gaussians, title: str) -> ViewerScene:
    """Return what the viewer page shows of the run besides its splat.

    Args:
        inputs: The stage's inputs.
        gaussians: In the world frame.
        title: The page's title.
    """
    options, _ = as_trained(inputs["train.rendering"], gaussians)
    rendering = viewer_rendering(options, read_panorama(inputs["train.sky"]))
    frame = load_frame(inputs["georef.frame"])
    scene = viewer_scene(inputs["undistort.dataset"], frame, rendering, held_out_names(inputs), len(gaussians), title)
    if (area := read_world_area(inputs.parts.get("georef.boundary"))) is not None:
        scene = replace(scene, focus=area.contains(scene.points))
    return scene


def held_out_names(inputs: Inputs) -> frozenset[str]:
    """Names of the held-out photos that the model was evaluated on."""
    return frozenset(view["name"] for view in _read_json(inputs["evaluate.metrics"])["per_view"])


def collect_metrics(inputs: Inputs, points: Points, registered: int, gaussians: int) -> Facts:
    """Return the run's metrics, as stored in `metrics.json`.

    Args:
        inputs: The stage's inputs.
        points: Sparse points.
        registered: Number of registered photos.
        gaussians: Number of Gaussians in the splat.
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
        "judged_megapixels": measured["judged_megapixels"],
        "test_views": measured["test_views"],
        "held_out_views": measured["held_out_views"],
        **measured["mean"],
        **({"whole": measured["whole"]} if "whole" in measured else {}),  # with a boundary, the rest covers the inside
        "floaters": measured["floaters"],
        "accuracy": measured["accuracy"],
        "per_view": measured["per_view"],
        "seed": train.get("plan", {}).get("seed"),
        "device": train.get("device"),
        "versions": {name: _version(name) for name in VERSIONS} | {"python": platform.python_version()},
    }


def count_photos(inputs: Inputs, registered: int) -> int:
    """Number of photos the user gave, used or left out; the registered ones if the run did not start from photos."""
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
    """Mean reprojection error of the sparse points in the original photos, pixels; None without tracks.

    Args:
        model: The COLMAP model that the training dataset was made from.
    """
    reconstruction = read_reconstruction(model)
    reconstruction.update_point_3d_errors()  # models from other programs may lack them
    error = float(reconstruction.compute_mean_reprojection_error())
    return round(error, 4) if math.isfinite(error) and error > 0.0 else None


def _version(distribution: str) -> str | None:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None


def _read_json(path: Path) -> Any:
    try:
        return read_json(path)
    except (OSError, ValueError) as error:
        raise StageError(f"{path.name} cannot be read.", hint="Run again with --rerun.") from error
