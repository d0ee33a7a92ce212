"""The demo capture after an ideal structure from motion: exact cameras, noisy observations.

Points lie on the true surface and are seen by every photo that they face, even through walls, which does not affect the
geometry.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from splatpipe.demo import CAPTURE
from splatpipe.demo.truth.truth import true_surface
from splatpipe.pipeline.engine.runs.source import ABSENT
from splatpipe.pipeline.geometry.similarity import Similarity, rotation_from_vector
from splatpipe.pipeline.photos.files.photo_list import Photo, PhotoList, save_photo_list
from splatpipe.pipeline.sfm.model.sparse_model import write_model
from splatpipe.pipeline.survey.crs.geodesy import Origin
from splatpipe.pipeline.survey.targets.target_finds import WantedTargets, save_finds, save_wanted

Array = NDArray[np.float64]
TRUTH: dict[str, Any] = json.loads((CAPTURE / "truth.json").read_text(encoding="utf-8"))
PLACE = Origin(**TRUTH["frame"]["origin"])
WIDTH, HEIGHT = TRUTH["camera"]["width"], TRUTH["camera"]["height"]
LENS = tuple(TRUTH["camera"]["params"])  # SIMPLE_RADIAL's parameters: f, cx, cy in pixels, k
POINTS = {point["name"]: point for point in TRUTH["points"]}
MODEL_FROM_WORLD = Similarity(0.137, rotation_from_vector(np.array([0.4, -1.1, 2.0])), np.array([0.3, -0.2, 1.4]))
NADIR = tuple(f"DJI_00{number}.JPG" for number in range(32, 41))
FEATURE_PX = 0.3
MARK_PX = 0.3


@dataclass(frozen=True)
class Row:
    """A line of a control file, as fields."""

    name: str
    place: tuple[float, float, float]
    photo: str
    pixel: tuple[float, float]


def surface_points(count: int, seed: int = 0) -> tuple[Array, Array]:
    """Sample the true surface within the site, uniformly by area; return the places and the surface's normals."""
    triangles = true_surface()
    triangles = triangles[np.abs(triangles[:, :, :2]).max(axis=(1, 2)) < 40.0]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    rng = np.random.default_rng(seed)
    chosen = rng.choice(len(areas), count, p=areas / areas.sum())
    u, v = rng.uniform(size=(2, count, 1))
    u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
    corners = triangles[chosen]
    places = corners[:, 0] + u * (corners[:, 1] - corners[:, 0]) + v * (corners[:, 2] - corners[:, 0])
    return places, normals[chosen] / areas[chosen, None]


def true_model(
    photos: Sequence[str] | None = None, points: int = 900, seed: int = 0, flat: bool = False
) -> pycolmap.Reconstruction:
    """Return a model of exact cameras and points with noisy features, in the true world; or over flat ground alone."""
    rng = np.random.default_rng(seed)
    places, normals = surface_points(points, seed)
    if flat:
        places = np.column_stack([rng.uniform(-25.0, 25.0, (points, 2)), np.zeros(points)])
        normals = np.tile([0.0, 0.0, 1.0], (points, 1))
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", LENS[0], WIDTH, HEIGHT)
    camera.params = list(LENS)
    model.add_camera_with_trivial_rig(camera)
    tracks: list[list[pycolmap.TrackElement]] = [[] for _ in places]
    for number, truth in enumerate(TRUTH["photos"], 1):
        if photos is not None and truth["name"] not in photos:
            continue
        pose = np.array(truth["cam_from_world"])[:3]
        seen = places @ pose[:, :3].T + pose[:, 3]
        facing = ((np.array(truth["centre_m"]) - places) * normals).sum(axis=1) > 0.0
        pixels = np.asarray(camera.img_from_cam(seen))
        inside = (pixels > 0.0).all(axis=1) & (pixels < [WIDTH, HEIGHT]).all(axis=1) & (seen[:, 2] > 1.0)
        visible = np.flatnonzero(facing & inside)
        noisy = pixels[visible] + rng.normal(size=(len(visible), 2)) * FEATURE_PX
        image = pycolmap.Image(truth["name"], noisy, 1, number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
        for k, point in enumerate(visible.tolist()):
            tracks[point].append(pycolmap.TrackElement(number, k))
    for place, track in zip(places, tracks, strict=True):
        if len(track) >= 2:
            model.add_point3D(place, pycolmap.Track(track), np.array([128, 128, 128], np.uint8))
    return model


def adjusted(
    model: pycolmap.Reconstruction, focal: float | None = None, k1: float | None = None
) -> pycolmap.Reconstruction:
    """Return a model after free bundle adjustment; a given focal length or distortion is held fixed."""
    options = pycolmap.BundleAdjustmentOptions()
    options.ceres.solver_options.num_threads = 1
    held = focal is not None
    options.refine_focal_length = options.refine_extra_params = not held
    options.print_summary = False
    if held:
        model.cameras[1].params = [focal, LENS[1], LENS[2], k1]
    config = pycolmap.BundleAdjustmentConfig()
    for number in model.reg_image_ids():
        config.add_image(number)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()
    return model


def positions(kind: str, sigma: tuple[float, float], lift: float = 0.0) -> list[dict[str, Any]]:
    """Return records of ``positions.json``: the truth with its injected errors, ``gps`` or ``rtk``."""
    records = []
    for truth in TRUTH["photos"]:
        stated = np.array(truth["centre_m"]) + np.array(truth[f"{kind}_error_m"])
        latitude, longitude, height = PLACE.geodetic_from_enu(stated[None])[0].tolist()
        record = {"name": truth["name"], "latitude": latitude, "longitude": longitude, "altitude_m": height + lift}
        record |= {"sigma_horizontal_m": sigma[0], "sigma_vertical_m": sigma[1], "relative_altitude_m": None}
        records.append(record | dict.fromkeys(("yaw_deg", "pitch_deg", "roll_deg")))
    return records


def rows(names: Sequence[str], photos: Sequence[str] | None = None, seed: int = 0) -> list[Row]:
    """Return noisy marks of surveyed points."""
    rng = np.random.default_rng(seed)
    found = []
    for name in names:
        point = POINTS[name]
        for photo, pixel in sorted(point["seen_px"].items()):
            x, y = (np.array(pixel) + rng.normal(size=2) * MARK_PX).tolist()
            if photos is None or photo in photos:
                found.append(Row(name, tuple(point["utm_m"]), photo, (x, y)))
    return found


def gcp_list(lines: Sequence[Row], crs: str = "EPSG:32633") -> str:
    """Return the text of ODM's file."""
    body = [
        f"{r.place[0]!r} {r.place[1]!r} {r.place[2]!r} {r.pixel[0]!r} {r.pixel[1]!r} {r.photo} {r.name}" for r in lines
    ]
    return "\n".join([crs, *body]) + "\n"


def capture_parts(
    folder: Path, model: pycolmap.Reconstruction, records: list[dict[str, Any]], control: str
) -> dict[str, Path]:
    """Return the parts that georef reads."""
    folder.mkdir(parents=True, exist_ok=True)
    moved = pycolmap.Reconstruction(model)
    rotation = pycolmap.Rotation3d(MODEL_FROM_WORLD.rotation)
    moved.transform(pycolmap.Sim3d(MODEL_FROM_WORLD.scale, rotation, MODEL_FROM_WORLD.translation))
    write_model(moved, folder / "model")
    names = [photo["name"] for photo in TRUTH["photos"]]
    save_photo_list(PhotoList(tuple(Photo(name, "0" * 64, WIDTH, HEIGHT, 0) for name in names)), folder)
    (folder / "positions.json").write_text(json.dumps({"positions": records, "orientations": {}}))
    (folder / "cameras.json").write_text(
        json.dumps({"cameras": [{"focal_px": 853.0, "width": WIDTH, "has_prior": True, "focal_source": "35mm"}]})
    )
    (folder / "lenses.json").write_text(json.dumps({"lenses": [None]}))
    (folder / "gcp_list.txt").write_text(control, encoding="utf-8")
    save_wanted(WantedTargets("", (), ()), folder / "points.json")
    save_finds((), folder / "targets.json")
    return {
        "sparse.model": folder / "model",
        "ingest.positions": folder / "positions.json",
        "ingest.photos": folder,
        "ingest.cameras": folder / "cameras.json",
        "ingest.lenses": folder / "lenses.json",
        "source.control": folder / "gcp_list.txt",
        "source.boundary": ABSENT,
        "control.points": folder / "points.json",
        "targets.found": folder / "targets.json",
    }


def moved_rows(lines: Sequence[Row], change: Callable[[Row], Row]) -> list[Row]:
    """Return every line, changed."""
    return [change(line) for line in lines]
