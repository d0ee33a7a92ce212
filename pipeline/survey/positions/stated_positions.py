"""The position file's entries for photos of the capture, as WGS 84 positions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.photos.files.names import NameFinder, hint_of_several, list_names
from splatpipe.pipeline.photos.metadata.camera_angles import detect_convention, gimbal_from_nadir
from splatpipe.pipeline.survey.crs.coordinate_readings import nearer_reading
from splatpipe.pipeline.survey.crs.crs import parse_crs, to_geodetic
from splatpipe.pipeline.survey.files.position_file import PhotoPlace, read_position_file


@dataclass(frozen=True)
class FilePlace:
    """A photo's position in the file.

    Attributes:
        latitude: Degrees north, WGS84.
        longitude: Degrees east, WGS84.
        altitude_m: In the datum ``vertical``; None where the file states none.
        vertical: ``ellipsoidal``, ``EPSG:n`` or ``unknown``, by the file's CRS.
        angles_deg: Yaw, pitch (-90 straight down) and roll of the camera; None where they are unknown.
        sigma_m: Horizontal and vertical standard deviation; None where the file states none.
    """

    latitude: float
    longitude: float
    altitude_m: float | None
    vertical: str
    angles_deg: tuple[float, float, float] | None
    sigma_m: tuple[float | None, float | None]


@dataclass(frozen=True)
class FilePlaces:
    """The photos in the file.

    Attributes:
        by_name: Entries for photos of the capture, by the photo's name.
        unknown: Names in the file that match no photo.
        note: The CRS and the operation from it to WGS 84, as a sentence.
        name: The file's name.
        better: A hint at how to read the file, where as it stands it lies far from the photos' own positions.
    """

    by_name: Mapping[str, FilePlace]
    unknown: tuple[str, ...]
    note: str
    name: str = ""
    better: str = ""


def read_places(
    path: Path,
    photos: Iterable[str],
    own: Mapping[str, tuple[float, float]] | None = None,
    *,
    approximate: bool = False,
) -> FilePlaces:
    """Read a position file.

    Args:
        path: The file.
        photos: Names of the photos in use.
        own: Latitude and longitude that they state themselves, by name.
        approximate: Accept a CRS although the grid of its best operation to WGS 84 is missing.

    Raises:
        SplatpipeError: if it is not such a file, names none of the photos, or its CRS cannot be used.
    """
    names = list(photos)
    file = read_position_file(path, names)
    find = NameFinder(names)
    matched: dict[str, PhotoPlace] = {}
    unknown: list[str] = []
    for photo in file.photos:
        name = find(photo.name)
        if name is None or name in matched:
            unknown.append(photo.name)
        else:
            matched[name] = photo
    if not matched:
        raise SplatpipeError(
            f"{path.name} lists no photo of this capture: {list_names(unknown)}.",
            hint_of_several(unknown, names)
            or "It may belong to another capture: give the right one with --set ingest.positions=PATH, or =none to "
            "ignore it.",
        )
    crs = parse_crs(file.crs)
    rows = list(matched.values())
    points = np.array([[row.x, row.y, np.nan if row.z is None else row.z] for row in rows], dtype=np.float64)
    known = np.array([[*own[name], 0.0] for name in matched if own and name in own], dtype=np.float64).reshape(-1, 3)
    better = nearer_reading(points[:, :2], crs, known) if len(known) else ""
    try:
        located = to_geodetic(points, crs, approximate)
    except SplatpipeError as error:
        raise SplatpipeError(f"{path.name}: {error}", better or error.hint) from error
    angles = _gimbal_angles(rows)
    places = {
        name: FilePlace(
            float(latitude), float(longitude), float(up) if np.isfinite(up) else None, crs.vertical, turned, row.sigma_m
        )
        for name, row, turned, (latitude, longitude, up) in zip(matched, rows, angles, located.geodetic, strict=True)
    }
    return FilePlaces(places, tuple(unknown), f"{crs.text} ({crs.name}) by {located.operation.name}", path.name, better)


def _gimbal_angles(rows: Sequence[PhotoPlace]) -> list[tuple[float, float, float] | None]:
    """The photos' angles in the gimbal's convention, whichever of the two conventions the file uses."""
    known = [row.angles_deg for row in rows if row.angles_deg is not None]
    if detect_convention(angles[1] for angles in known) == "gimbal":
        return [row.angles_deg for row in rows]
    return [None if row.angles_deg is None else gimbal_from_nadir(*row.angles_deg) for row in rows]
