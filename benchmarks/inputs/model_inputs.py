"""Field inputs: COLMAP folders, made from the demo's true cameras and points of its true surface."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path, PurePosixPath

import numpy as np
import pycolmap
from field_case import DEMO, FieldInput, demo_bytes
from PIL import Image
from scipy.spatial.transform import Rotation

TRUTH = json.loads((DEMO / "truth.json").read_text())
USED = range(0, 40, 4)
POINTS = 1500


def surface_points() -> np.ndarray:
    """Return points of the demo's surface, in metres."""
    data = (DEMO / "surface.ply").read_bytes()
    start = data.index(b"end_header\n") + len(b"end_header\n")
    vertices = np.frombuffer(data, "<f4", 3 * 22548, start).reshape(-1, 3)
    return vertices[np.random.default_rng(0).choice(len(vertices), POINTS, replace=False)]


def write_model(
    folder: Path,
    indices: range | list[int] = USED,
    *,
    rename: Callable[[str], str] = str,
    scale: float = 1.0,
    camera_of: Callable[[int], int] = lambda _: 1,
    points: bool = True,
    written: Callable[[int], bool] = lambda _: True,
) -> None:
    """Write a model as text.

    Args:
        folder: Folder of the three files.
        indices: Photos of the demo.
        rename: The photo's name in the model.
        scale: Length of the model's quaternions.
        camera_of: Identifier of a photo's camera.
        points: Whether it has points.
        written: Whether a camera of an identifier is in cameras.txt.
    """
    folder.mkdir(parents=True)
    model = TRUTH["camera"]
    cameras = sorted({camera_of(i) for i in indices})
    params = " ".join(map(str, model["params"]))
    (folder / "cameras.txt").write_text(
        "# Camera list\n" + "".join(f"{c} {model['model']} 1200 900 {params}\n" for c in cameras if written(c))
    )
    xyz = surface_points().astype(float)
    lines: list[str] = []
    tracks: list[list[str]] = [[] for _ in xyz]
    for number, i in enumerate(indices, 1):
        photo = TRUTH["photos"][i]
        pose = np.array(photo["cam_from_world"])
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat() * scale
        cam = xyz @ pose[:3, :3].T + pose[:3, 3]
        plane = cam[:, :2] / cam[:, 2:]
        radial = 1 + model["params"][3] * (plane**2).sum(1, keepdims=True)
        px = model["params"][0] * plane * radial + model["params"][1:3]
        seen = np.flatnonzero((cam[:, 2] > 1) & (px > 0).all(1) & (px < (1200, 900)).all(1)) if points else []
        for at, point in enumerate(seen):
            tracks[point].append(f"{number} {at}")
        pose_text = " ".join(f"{v:.9f}" for v in (w, x, y, z, *pose[:3, 3]))
        lines.append(f"{number} {pose_text} {camera_of(i)} {rename(photo['name'])}")
        lines.append(" ".join(f"{px[p, 0]:.3f} {px[p, 1]:.3f} {p + 1}" for p in seen))
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    (folder / "points3D.txt").write_text(
        "".join(
            f"{p + 1} {xyz[p, 0]:.5f} {xyz[p, 1]:.5f} {xyz[p, 2]:.5f} 90 90 90 0.5 {' '.join(track)}\n"
            for p, track in enumerate(tracks)
            if len(track) > 1
        )
    )


def write_photos(folder: Path, indices: range | list[int] = USED, rename: Callable[[str], str] = str) -> None:
    """Write the photos of a model."""
    for i in indices:
        path = folder / rename(f"DJI_{i + 1:04}.JPG")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(demo_bytes(i))


def windows_folders(folder: Path) -> None:
    """A model made on Windows: photos in subfolders, with backslashes in images.txt, and blanks in the names."""

    def subfolder(name: str) -> str:
        return f"flight {int(name[4:8]) % 2 + int(name[4:8]) // 20}/{name.replace('_', ' ')}"

    write_model(folder / "cm/sparse/0", rename=lambda name: subfolder(name).replace("/", "\\"))
    write_photos(folder / "cm/images", rename=subfolder)


def several_models(folder: Path) -> None:
    """sparse/0 with two photos, sparse/1 with all the others; binary, with rigs and frames, as COLMAP 4 writes it."""
    for name, indices in (("0", [0, 2]), ("1", list(range(4, 40, 4)))):
        write_model(folder / f"text{name}", indices)
        binary = folder / f"cm/sparse/{name}"
        binary.mkdir(parents=True)
        pycolmap.Reconstruction(folder / f"text{name}").write_binary(binary)
    write_photos(folder / "cm/images")


def small_photos(folder: Path) -> None:
    """A model without the 0 (sparse/cameras.txt) of photos at full size, beside images at half their size."""
    write_model(folder / "cm/sparse", scale=1.7)
    (folder / "cm/images").mkdir()
    for i in USED:
        with Image.open(DEMO / f"photos/DJI_{i + 1:04}.JPG") as image:
            image.resize((600, 450)).save(folder / f"cm/images/DJI_{i + 1:04}.JPG", quality=90)


def other_extensions(folder: Path) -> None:
    """images.txt says PNG, the folder has JPG; no points, as a game engine or a scanner exports it."""
    write_model(folder / "cm/sparse/0", rename=lambda name: f"{PurePosixPath(name).stem}.png", points=False)
    write_photos(folder / "cm/images")


def missing_camera(folder: Path) -> None:
    """Two cameras in images.txt, one in cameras.txt."""
    write_model(folder / "cm/sparse/0", camera_of=lambda i: 1 + i % 8 // 4, written=lambda camera: camera == 1)
    write_photos(folder / "cm/images")


def windows_text(folder: Path) -> None:
    """A model edited on Windows: byte order marks, CRLF; images.txt redirected by PowerShell (UTF-16)."""
    write_model(folder / "cm/sparse/0", rename=lambda name: name.replace("DJI_", "Höhe "))
    write_photos(folder / "cm/images", rename=lambda name: name.replace("DJI_", "Höhe "))
    for name, encoding in (("cameras", "utf-8-sig"), ("images", "utf-16"), ("points3D", "utf-8-sig")):
        path = folder / f"cm/sparse/0/{name}.txt"
        path.write_bytes(path.read_text(encoding="utf-8").replace("\n", "\r\n").encode(encoding))


def one_line_photos(folder: Path) -> None:
    """Known poses from a script: images.txt without the lines of keypoints, points3D.txt empty."""
    write_model(folder / "cm/sparse/0", points=False)
    path = folder / "cm/sparse/0/images.txt"
    path.write_text("".join(f"{line}\n" for line in path.read_text().splitlines() if line))
    write_photos(folder / "cm/images")


def stripped_text(folder: Path) -> None:
    """The same with the empty lines, but an editor has stripped those at the end."""
    write_model(folder / "cm/sparse/0", points=False)
    path = folder / "cm/sparse/0/images.txt"
    path.write_text(path.read_text().rstrip("\n") + "\n")
    write_photos(folder / "cm/images")


def thinned_points(folder: Path) -> None:
    """points3D.txt thinned out to every tenth point; images.txt still refers to all."""
    write_model(folder / "cm/sparse/0")
    path = folder / "cm/sparse/0/points3D.txt"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[::10]))
    write_photos(folder / "cm/images")


MODEL_INPUTS = (
    FieldInput(
        "windows_folders",
        windows_folders,
        ("run cm out --until georef",),
        0,
        silent_on=("missing in images/", "not in the model"),
        mended="names cut at their blanks",
    ),
    FieldInput(
        "several_models",
        several_models,
        ("run cm out --until georef",),
        0,
        ("sparse/1 with 9 photos is used; sparse/0 has 2",),
        mended="sparse/0, in silence",
    ),
    FieldInput("small_photos", small_photos, ("run cm out --until georef",), 0),
    FieldInput("other_extensions", other_extensions, ("run cm out --until georef",), 0),
    FieldInput(
        "missing_camera",
        missing_camera,
        ("run cm out --until georef",),
        1,
        ("DJI_0005.JPG has camera 2, which is not in cameras.txt",),
        mended='"Rig with ID 2 does not exist"',
    ),
    FieldInput(
        "windows_text",
        windows_text,
        ("run cm out --until georef",),
        0,
        silent_on=("missing in images/", "not in the model"),
        mended="refused in C++",
    ),
    FieldInput(
        "one_line_photos",
        one_line_photos,
        ("run cm out --until georef",),
        1,
        ("each photo has two lines, of which the second may be empty",),
        mended="every other photo lost in silence",
    ),
    FieldInput(
        "stripped_text",
        stripped_text,
        ("run cm out --until georef",),
        0,
        silent_on=("missing in images/", "not in the model"),
        mended="the last photo lost in silence",
    ),
    FieldInput("thinned_points", thinned_points, ("run cm out --until undistort",), 0, mended='"KeyError"'),
)
