"""Render flights whose truth is known, run them from photos, and compare the ground: ``rendered_blocks WORK``.

The flights are those of ``position_scenes``: 48 photos straight down, in strips of one height (``flat``) or of heights
that alternate by 8 m, with positions stated to 1.4 and 2.1 cm. The ground is flat and painted as the demo's is; photos
are rendered by the demo's generator (``pip install 'splatpipe[demo]'`` and an LLVM library). Renders and runs are kept
in WORK, and what is there is not done again. ``today``: the same with ``--set georef.adjust=off``.

Each point of the sparse model is compared with where the true rays of its observations meet the ground; those whose
rays disagree by more than 3 GSD are wrong matches and do not count.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float64
from PIL import Image
from PIL.TiffImagePlugin import IFDRational
from position_scenes import STATED_M, Scene, draw_scene
from tables import Row, print_table

from splatpipe.demo.generate import RTK_XMP, compress, develop
from splatpipe.demo.photography.cameras import BrownLens, Pose
from splatpipe.demo.photography.geodesy import Origin
from splatpipe.demo.photography.metadata import (
    EXIF_IFD,
    GpsPosition,
    build_exif,
    build_xmp,
    position_attributes,
    with_metadata,
)
from splatpipe.demo.photography.render import Renderer
from splatpipe.demo.site.mesh import WORLD, Builder, paint_faces
from splatpipe.demo.site.scene import DemoScene
from splatpipe.demo.site.surroundings import GRAVEL, LAWN, SOIL, TERRACE
from splatpipe.pipeline.engine.python_module import python_module
from splatpipe.pipeline.survey.crs.frames import load_frame
from splatpipe.pipeline.survey.placing.uncertainty import NORMAL_95

BLOCKS = ("flat", "alternating")
HALF_M, TEXEL_M = 62.0, 0.0165  # half side of the painted ground, and size of its texels
PATHS = 6  # a pixel
MEAN_PHOTO_BYTES = 900_000  # mean size of a photo's file
PAUSE_S = 3
SENSOR_MM, FULL_FRAME_MM = 17.3, 43.27  # width of the camera model's sensor, and diagonal of 35 mm film
AGREED_GSDS = 3.0
COLUMNS = {
    "block": "block:",
    "georef": "how:",
    "points": "points:",
    **{f"GSD {axis}": f"error_{axis}:.2f" for axis in "ENU"},
    **{f"mean {axis}": f"mean_{axis}:.2f" for axis in "ENU"},
    "off plane": "plane:.2f",
    "told ± (95 %)": "told:.2f",
    "f off %": "focal:.2f",
}


@dataclass(frozen=True)
class ExactPose(Pose):
    """A pose given by its matrix."""

    matrix: Float64[np.ndarray, "4 4"]

    @property
    def world_from_cam(self) -> Float64[np.ndarray, "4 4"]:
        return self.matrix


def flat_ground(seed: int) -> DemoScene:
    """Four fields in one plane."""
    builder = Builder()
    for (east, north), paint in zip(((-1, -1), (0, -1), (-1, 0), (0, 0)), (LAWN, SOIL, GRAVEL, TERRACE), strict=True):
        low = HALF_M * np.array([east, north])
        builder.rect(WORLD, low.tolist(), (low + HALF_M).tolist(), paint, texel_m=TEXEL_M)
    return DemoScene(paint_faces(builder.faces, seed), [])


def poses_of(scene: Scene) -> list[ExactPose]:
    """The flight's poses; the angles are those that a gimbal would state."""
    poses = []
    for number, (rotation, centre) in enumerate(zip(scene.rotations, scene.centres, strict=True)):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation.T, centre
        top = -rotation[1]  # the photo's upper edge points there
        yaw = float(np.degrees(np.arctan2(top[0], top[1])))
        poses.append(ExactPose(f"DJI_{number + 1:04d}.JPG", centre, yaw, -90.0, 0.0, matrix))
    return poses


def lens_of(camera: pycolmap.Camera) -> BrownLens:
    """The generator's form of a lens without k3."""
    f, _, cx, cy, k1, k2, p1, p2, *_ = camera.params.tolist()
    return BrownLens(camera.width, camera.height, f, cx, cy, k1, k2, 0.0, p1, p2)


def write_photos(scene: Scene, work: Path, seed: int) -> Path:
    """Render a flight; return the folder of its photos, with the receiver's positions."""
    photos = work / "photos"
    if (work / "whole").exists():
        return photos
    lens, origin, poses = lens_of(scene.camera), Origin(), poses_of(scene)
    renders = work / "renders"
    renders.mkdir(parents=True, exist_ok=True)
    renderer, rng = None, np.random.default_rng(seed)
    developed = []
    for number, pose in enumerate(poses):
        file = renders / f"{pose.name}.npy"
        if not file.exists():
            renderer = renderer or Renderer(flat_ground(seed))
            partial = file.with_suffix(".part.npy")
            np.save(partial, renderer.photo(pose, lens, PATHS, number).astype(np.float16))
            partial.rename(file)
            print(f"{pose.name}: rendered ({number + 1} of {len(poses)})", flush=True)
        developed.append(develop(np.load(file).astype(np.float64), 0.0, rng))
    photos.mkdir(exist_ok=True)
    start = datetime(2026, 6, 18, 11, 0, 0)
    places = origin.geodetic(scene.positions.stated)
    stated = {"RtkStdLon": STATED_M[0], "RtkStdLat": STATED_M[1], "RtkStdHgt": STATED_M[2]}
    calibrated = {"CalibratedFocalLength": f"{scene.stated.params[0]:.6f}"}
    for number, (pose, jpeg) in enumerate(zip(poses, compress(developed, MEAN_PHOTO_BYTES * len(poses)), strict=True)):
        taken = (start + timedelta(seconds=PAUSE_S * number)).strftime("%Y:%m:%d %H:%M:%S")
        position = GpsPosition(*(float(x) for x in places[number]))
        angles = {"GimbalRollDegree": "+0.00", "GimbalYawDegree": f"{pose.yaw_deg:+.2f}", "GimbalPitchDegree": "-90.00"}
        attributes = {**angles, **calibrated, **position_attributes(position), **RTK_XMP}
        attributes |= {key: f"{value:.5f}" for key, value in stated.items()}
        exif = Image.Exif()
        exif.load(build_exif((lens.width, lens.height), taken, 1 / 640, position))
        focal_mm = scene.stated.params[0] * SENSOR_MM / lens.width
        focal_35mm = scene.stated.params[0] * FULL_FRAME_MM / math.hypot(lens.width, lens.height)
        exif.get_ifd(EXIF_IFD).update({0x920A: IFDRational(round(100 * focal_mm), 100), 0xA405: round(focal_35mm)})
        (photos / pose.name).write_bytes(with_metadata(jpeg, exif.tobytes(), build_xmp(taken, attributes)))
    (work / "whole").touch()
    return photos


def run_to_georef(photos: Path, out: Path, *options: str) -> None:
    """Run the line up to georef."""
    command = python_module("splatpipe.pipeline.app.cli.main", "run", str(photos), str(out), "--preset", "preview")
    subprocess.run([*command, "--until", "georef", *options], check=True)


def stage_of(out: Path, name: str) -> Path:
    """The folder of a finished stage."""
    return max((out / "stages").glob(f"{name}-*"), key=lambda path: path.stat().st_mtime)


def compared(scene: Scene, out: Path, block: str, how: str) -> Row:
    """Compare a run's sparse model with the truth."""
    folder = stage_of(out, "georef")
    frame = load_frame(folder / "frame.json")
    accuracy = json.loads((folder / "accuracy.json").read_text(encoding="utf-8"))
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    names = {f"DJI_{k + 1:04d}.JPG": k for k in range(len(scene.centres))}
    assert frame.origin is not None
    shift = frame.origin.enu_from_geodetic(Origin().geodetic(np.zeros((1, 3))))[0]
    places, spots, spread = [], [], []
    rays = {
        k: np.asarray(scene.camera.cam_from_img(pixels_of(model.find_image_with_name(name), model, scene)))
        for name, k in names.items()
        if model.find_image_with_name(name) is not None
    }
    for point in model.points3D.values():
        if point.track.length() < 3:
            continue
        hits = []
        for element in point.track.elements:
            k = names[model.images[element.image_id].name]
            way = scene.rotations[k].T @ [*rays[k][element.point2D_idx], 1.0]
            hits.append(scene.centres[k] - way * scene.centres[k][2] / way[2])
        middle = np.median(hits, axis=0)
        places.append(frame.world_from_model.apply(point.xyz[None])[0] - shift)
        spots.append(middle)
        spread.append(float(np.linalg.norm(np.array(hits) - middle, axis=1).max()))
    true, errors = np.array(spots), np.array(places) - np.array(spots)
    low, high = scene.centres[:, :2].min(axis=0), scene.centres[:, :2].max(axis=0)
    good = np.array(spread) < AGREED_GSDS * scene.gsd_m
    good &= ((true[:, :2] > low) & (true[:, :2] < high)).all(axis=1)
    true, errors = true[good], errors[good] / scene.gsd_m
    design = np.column_stack([np.ones(len(true)), true[:, :2]])
    bent = errors[:, 2] - design @ np.linalg.lstsq(design, errors[:, 2], rcond=None)[0]
    adjustment = accuracy.get("adjustment") or {}
    focal = next(iter(model.cameras.values())).params[0] * scene.camera.width / next(iter(model.cameras.values())).width
    row: Row = {"block": block, "how": how, "points": int(good.sum()), "plane": float(np.sqrt((bent**2).mean()))}
    row |= {f"error_{axis}": float(value) for axis, value in zip("ENU", np.sqrt((errors**2).mean(axis=0)), strict=True)}
    row |= {f"mean_{axis}": float(value) for axis, value in zip("ENU", errors.mean(axis=0), strict=True)}
    row |= {"told": float("nan"), "focal": 100.0 * (focal / scene.camera.params[0] - 1.0)}
    heights = adjustment.get("heights")
    if heights:
        row["told"] = NORMAL_95 * heights["together_sigma_m"][2] / scene.gsd_m
    return row


def pixels_of(image: pycolmap.Image, model: pycolmap.Reconstruction, scene: Scene) -> Float64[np.ndarray, "m 2"]:
    """An image's keypoints in pixels of the photo."""
    width = model.cameras[image.camera_id].width
    points = np.array([point.xy for point in image.points2D], np.float64).reshape(-1, 2)
    return points * (scene.camera.width / width)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("work", type=Path)
    options.add_argument("--block", choices=BLOCKS, action="append")
    options.add_argument("--seed", type=int, default=0)
    arguments = options.parse_args()
    rows = []
    for block in arguments.block or BLOCKS:
        scene, work = draw_scene(block, "none", arguments.seed), arguments.work / f"{block}-{arguments.seed}"
        photos = write_photos(scene, work, arguments.seed)
        for how, extra in (("adjusted", ()), ("today", ("--set", "georef.adjust=off"))):
            run_to_georef(photos, work / "out", *extra)
            rows.append(compared(scene, work / "out", block, how))
            print(json.dumps(rows[-1]), flush=True)
    print_table("ground of rendered blocks, from photos (GSD)", rows, COLUMNS)


if __name__ == "__main__":
    main()
