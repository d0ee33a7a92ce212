"""The placed photos as ODM's clients read them: `shots.geojson` for the map, `cameras.json` with the lenses.

Both follow OpenSfM's documentation of reconstructions: lengths on the sensor are shares of the photo's longer side,
rotations take world axes to the camera's (x right, y down, z forward) and are axis times angle (radians). Here the
world is the CRS of the maps.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from splatpipe.pipeline.app.node.assets.earth import Earth
from splatpipe.pipeline.photos.colmap.colmap_file import (
    CAMERA,
    CAMERAS,
    COUNT,
    IMAGE,
    IMAGES,
    OBSERVATION,
    ModelFile,
)

BROWN = ("k1", "k2", "p1", "p2", "k3")
# Parameters of COLMAP's camera models, by its ids (its documentation, "Camera models").
MODELS = {
    0: ("f", "cx", "cy"),
    1: ("fx", "fy", "cx", "cy"),
    2: ("f", "cx", "cy", "k1"),
    3: ("f", "cx", "cy", "k1", "k2"),
    4: ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    5: ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    6: ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    8: ("f", "cx", "cy", "k1"),
    9: ("f", "cx", "cy", "k1", "k2"),
}
FISHEYE = (5, 8, 9)
RATIONAL = 6  # OpenSfM has no denominator
LON_LAT_DIGITS, METRE_DIGITS, ROTATION_DIGITS = 9, 4, 9  # a tenth of a millimetre; a billionth of a radian


@dataclass(frozen=True)
class Lens:
    """A camera of the sparse model.

    Attributes:
        model: COLMAP's id of its model.
        width: Of its photos, pixels.
        height: Likewise.
        parameters: By name, pixels where they are lengths.
    """

    model: int
    width: int
    height: int
    parameters: Mapping[str, float]

    @property
    def longer_px(self) -> int:
        """The longer side of its photos."""
        return max(self.width, self.height)

    @property
    def focal_px(self) -> float:
        """Its focal length along x, pixels."""
        return self.parameters.get("fx", self.parameters.get("f", 0.0))


@dataclass(frozen=True, eq=False)
class Shot:
    """A placed photo.

    Attributes:
        name: Its name.
        lens: Number of its camera.
        cam_from_model: Its pose in the model's frame.
    """

    name: str
    lens: int
    cam_from_model: Float64[np.ndarray, "3 4"]


@dataclass(frozen=True, eq=False)
class Flight:
    """The placed photos of a run, and their cameras by number.

    Attributes:
        shots: Sorted by name.
        lenses: By COLMAP's number.
    """

    shots: tuple[Shot, ...]
    lenses: Mapping[int, Lens]

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Width and height of each photo by name."""
        return {shot.name: (self.lenses[shot.lens].width, self.lenses[shot.lens].height) for shot in self.shots}


def read_flight(model: Path) -> Flight:
    """Read poses and cameras of a COLMAP model, and neither keypoints nor points.

    Args:
        model: Its folder.

    Raises:
        OSError: if a file cannot be read.
        ValueError: if one is broken.
    """
    file, lenses = ModelFile(model / CAMERAS), {}
    for _ in range(file.count(CAMERA.size)):
        number, kind, width, height = file.take(CAMERA)
        if kind not in MODELS or min(width, height) < 1:
            raise ValueError(f"a camera of COLMAP's model {kind}")
        values = file.take(struct.Struct(f"<{len(MODELS[kind])}d"))
        lenses[number] = Lens(kind, width, height, dict(zip(MODELS[kind], values, strict=True)))
    file, shots = ModelFile(model / IMAGES), []
    for _ in range(file.count(IMAGE.size + 1 + COUNT.size)):
        _, *pose, lens = file.take(IMAGE)
        name = file.name()
        file.skip(file.count(OBSERVATION.itemsize) * OBSERVATION.itemsize)
        if lens not in lenses or not np.isfinite(pose).all() or not any(pose[:4]):
            raise ValueError(f"{name} has no camera or no pose")
        rotation = Rotation.from_quat(pose[:4], scalar_first=True).as_matrix()
        shots.append(Shot(name, lens, np.hstack([rotation, np.array(pose[4:])[:, None]])))
    return Flight(tuple(sorted(shots, key=lambda shot: shot.name)), lenses)


def shots_geojson(flight: Flight, earth: Earth, photos: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """`shots.geojson`: a point (longitude, latitude, height) for each placed photo.

    Args:
        flight: The placed photos.
        earth: Where the run lies.
        photos: The checked photos, of `ingest.photos`.
    """
    moments = {str(photo.get("name")): _epoch_s(photo.get("time")) for photo in photos}
    features: list[dict[str, Any]] = []
    centres = [_centre(shot, earth) for shot in flight.shots]
    local = np.array(centres).reshape(-1, 3)
    placed = zip(flight.shots, local, earth.crs.crs_from_local(local), earth.lon_lat_alt(local), strict=True)
    for shot, centre, there, position in placed:
        lens = flight.lenses[shot.lens]
        moment = moments.get(shot.name)
        properties = {
            "filename": shot.name,
            "camera": lens_name(shot.lens, lens),
            "focal": round(lens.focal_px / lens.longer_px, ROTATION_DIGITS),
            "width": lens.width,
            "height": lens.height,
            **({} if moment is None else {"capture_time": moment}),
            "translation": _rounded(there, METRE_DIGITS),
            "rotation": _rounded(_axis_angle(shot, centre, earth), ROTATION_DIGITS),
        }
        place = [*_rounded(position[:2], LON_LAT_DIGITS), round(float(position[2]), METRE_DIGITS)]
        features.append(
            {"type": "Feature", "properties": properties, "geometry": {"type": "Point", "coordinates": place}}
        )
    return {"type": "FeatureCollection", "features": features}


def cameras_json(flight: Flight) -> dict[str, Any]:
    """`cameras.json`: the calibrated lenses, by name; those that OpenSfM has no model for are left out."""
    return {
        lens_name(number, lens): _lens(lens)
        for number, lens in sorted(flight.lenses.items())
        if lens.model != RATIONAL or not any(lens.parameters[name] for name in ("k4", "k5", "k6"))
    }


def lens_name(number: int, lens: Lens) -> str:
    """The name of a camera, in OpenSfM's manner."""
    kind = "fisheye_opencv" if lens.model in FISHEYE else "brown"
    return f"splatpipe camera {number} {lens.width} {lens.height} {kind} {lens.focal_px / lens.longer_px:.4f}"


def _lens(lens: Lens) -> dict[str, Any]:
    values, longer = lens.parameters, lens.longer_px
    fisheye = lens.model in FISHEYE
    return {
        "projection_type": "fisheye_opencv" if fisheye else "brown",
        "width": lens.width,
        "height": lens.height,
        "focal_x": lens.focal_px / longer,
        "focal_y": values.get("fy", lens.focal_px) / longer,
        "c_x": (values["cx"] - lens.width / 2) / longer,
        "c_y": (values["cy"] - lens.height / 2) / longer,
        **{name: values.get(name, 0.0) for name in (("k1", "k2", "k3", "k4") if fisheye else BROWN)},
    }


def _centre(shot: Shot, earth: Earth) -> Float64[np.ndarray, " 3"]:
    """Its projection centre: east, north, up, metres."""
    centre = -shot.cam_from_model[:, :3].T @ shot.cam_from_model[:, 3]
    return np.asarray(earth.frame.world_from_model.apply(centre[None])[0])


def _axis_angle(shot: Shot, centre: Float64[np.ndarray, " 3"], earth: Earth) -> Float64[np.ndarray, " 3"]:
    model_from_local = np.asarray(earth.frame.world_from_model.rotation).T
    cam_from_crs = shot.cam_from_model[:, :3] @ model_from_local @ earth.grid_axes(centre)
    return np.asarray(Rotation.from_matrix(cam_from_crs).as_rotvec())


def _epoch_s(text: object) -> float | None:
    """A photo's own time, which has no zone, as seconds since the epoch as if it were UTC."""
    try:
        return datetime.fromisoformat(str(text)).replace(tzinfo=UTC).timestamp()
    except ValueError:
        return None


def _rounded(values: Float64[np.ndarray, " n"], digits: int) -> list[float]:
    return [round(float(value), digits) for value in values]
