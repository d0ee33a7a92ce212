"""Import an `all.zip` as WebODM does, with other people's readers, and compare its products with each other.

Rasters are opened by rasterio, the cloud by laspy, the mesh by trimesh, GeoJSON by pyogrio. All of them must have one
CRS, and lie at one place: to a pixel of the surface model; marks of surveyed points to some pixels of their photos.
"""

from __future__ import annotations

import json
import struct
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import laspy
import numpy as np
import pyogrio
import pyproj
import rasterio
import trimesh
from numpy.typing import NDArray
from rasterio.enums import ColorInterp
from rasterio.warp import transform_bounds
from rasterio.windows import Window
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
RASTERS = {
    "orthophoto.tif": "odm_orthophoto/odm_orthophoto.tif",
    "dsm.tif": "odm_dem/dsm.tif",
    "dtm.tif": "odm_dem/dtm.tif",
}
CLOUD = "odm_georeferencing/odm_georeferenced_model.laz"
CONTROL = "odm_georeferencing/ground_control_points.geojson"
GLB = "odm_texturing/odm_textured_model_geo.glb"
SHOTS = "odm_report/shots.geojson"
STATISTICS = "odm_report/stats.json"
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
SHOT_KEYS = {"filename", "width", "height", "focal", "rotation", "translation"}
MAX_MARK_PX = 5.0  # marks are read to half a pixel; wrong rotations are tens of pixels off
POINTS_AT_ONCE = 1_000_000


class ImportFailure(Exception):
    """WebODM could not import the file; its text is the reason."""


class BrokenArchive(ImportFailure):
    """The archive itself is broken, perhaps by its way here."""


@dataclass(frozen=True)
class Check:
    """One thing that has been looked at.

    Attributes:
        what: What.
        figure: What was found.
        met: Whether it is right.
    """

    what: str
    figure: str
    met: bool


@dataclass(frozen=True, eq=False)
class Map:
    """The raster that the others are compared with.

    Attributes:
        crs: Its horizontal CRS.
        bounds: Left, bottom, right, top.
        pixel: Its pixel's side.
    """

    crs: pyproj.CRS
    bounds: Array
    pixel: float

    def beyond(self, points: Array) -> float:
        """How far points lie outside of it, pixels."""
        low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
        return float(max((self.bounds[:2] - low).max(), (high - self.bounds[2:]).max(), 0.0) / self.pixel)


def import_archive(path: Path, folder: Path) -> list[Check]:
    """Unpack a file and look at everything in it.

    Args:
        path: `all.zip`.
        folder: Empty folder for its contents.

    Raises:
        ImportFailure: if WebODM could not import it.
    """
    root, top = unpack(path, folder)
    checks = [Check("entries at the top of all.zip", ", ".join(top), len(top) >= 2)]
    opened = {name: _open_raster(name, root / place) for name, place in RASTERS.items() if (root / place).is_file()}
    checks += [check for _, own in opened.values() for check in own]
    base = next((opened[name][0] for name in ("dsm.tif", "orthophoto.tif", "dtm.tif") if name in opened), None)
    if base is None:
        checks.append(Check("a map", "none", met=True))
    for name, (raster, _) in opened.items():
        checks.append(_same_extent(name, raster, base))
    readers: dict[str, Callable[[Path, Path, Map | None], Iterator[Check]]] = {
        CLOUD: check_cloud,
        GLB: check_mesh,
        SHOTS: check_shots,
        CONTROL: check_control,
        STATISTICS: check_statistics,
    }
    for place, read in readers.items():
        if (root / place).is_file():
            checks += read(root / place, root, base)
    return checks


def unpack(path: Path, folder: Path) -> tuple[Path, list[str]]:
    """Unpack an archive; a lone folder at its top is left out, as WebODM does.

    Returns:
        The folder with its contents, and the names at its top.

    Raises:
        ImportFailure: if it is broken, or has paths that lead out of it.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            for info in archive.infolist():
                place = PurePosixPath(info.filename)
                if place.is_absolute() or ".." in place.parts or "\\" in info.filename:
                    raise ImportFailure(f"{info.filename} leads out of the archive")
                if info.compress_type not in METHODS:
                    raise ImportFailure(f"{info.filename} is compressed by a method that clients do not know")
            archive.extractall(folder)
    except zipfile.BadZipFile as error:
        raise BrokenArchive(f"a broken archive: {error}") from error
    top = sorted(each.name for each in folder.iterdir())
    lone = len(top) == 1 and (folder / top[0]).is_dir()
    return (folder / top[0] if lone else folder), top


def _open_raster(name: str, path: Path) -> tuple[Map | None, list[Check]]:
    try:
        with rasterio.open(path) as raster:
            for row, column in ((0, 0), (raster.height // 2, raster.width // 2)):
                raster.read(window=Window(column, row, 1, 1))
            place = transform_bounds(raster.crs, "EPSG:4326", *raster.bounds)
            crs = horizontal(pyproj.CRS(raster.crs.to_wkt()))
            colours = raster.colorinterp == (*(ColorInterp.red, ColorInterp.green, ColorInterp.blue), ColorInterp.alpha)
            layout = raster.tags(ns="IMAGE_STRUCTURE").get("LAYOUT")
            found = Map(crs, np.array(raster.bounds), raster.transform.a)
            size = f"{raster.width} x {raster.height} of {raster.transform.a:g}, {crs.name}, {layout}"
            checks = [Check(f"{name} opens", size, bool(np.isfinite(place).all()) and layout == "COG")]
            if name == "orthophoto.tif":
                checks.append(Check(f"{name} is RGBA", str([each.name for each in raster.colorinterp]), colours))
            else:
                share = float((raster.read(1, masked=True).count()) / (raster.width * raster.height))
                checks.append(Check(f"{name} has heights", f"{share:.0%} of its cells", share > 0.0))
            return found, checks
    except (rasterio.RasterioIOError, pyproj.exceptions.CRSError, AttributeError) as error:
        raise ImportFailure(f"{name} does not open: endless downloads ({error})") from error


def horizontal(crs: pyproj.CRS) -> pyproj.CRS:
    """The horizontal part of a CRS."""
    return crs.sub_crs_list[0] if crs.is_compound else crs


def _same_extent(name: str, raster: Map | None, base: Map | None) -> Check:
    assert raster is not None and base is not None
    apart = float(np.abs(raster.bounds - base.bounds).max() / max(base.pixel, raster.pixel))
    same = raster.crs.equals(base.crs, ignore_axis_order=True)
    return Check(f"{name} and the surface model have one extent", f"{apart:.2f} px apart", apart <= 1.0 and same)


def check_cloud(path: Path, root: Path, base: Map | None) -> Iterator[Check]:
    """Open the cloud: its CRS, classes and place, and its heights against those of the surface model."""
    with laspy.open(path) as file:
        crs = file.header.parse_crs()
        box = np.stack([file.header.mins, file.header.maxs])
        classes: dict[int, int] = {}
        apart = []
        for chunk in file.chunk_iterator(POINTS_AT_ONCE):
            for number, count in zip(*np.unique(np.asarray(chunk.classification), return_counts=True), strict=True):
                classes[int(number)] = classes.get(int(number), 0) + int(count)
            apart.append(_over_surface(root, np.stack([chunk.x, chunk.y, chunk.z], axis=1)))
    ground = (root / RASTERS["dtm.tif"]).is_file()  # what the cloud's classes are made with
    yield Check("the cloud has classes where there is a terrain model", str(classes), (2 in classes) == ground)
    if base is None:
        return
    same = crs is not None and horizontal(crs).equals(base.crs, ignore_axis_order=True)
    yield Check("the cloud's CRS is the maps'", str(getattr(crs, "name", None)), same)
    yield Check("the cloud lies on the maps", f"{base.beyond(box):.2f} px beyond", base.beyond(box) <= 1.0)
    heights = np.concatenate(apart)
    middle = float(np.median(np.abs(heights))) if len(heights) else np.nan
    figure = f"median {100.0 * middle:.1f} cm of {len(heights):,} points"
    yield Check("the cloud's heights are the surface model's", figure, bool(middle <= base.pixel))


def _over_surface(root: Path, points: Array) -> Array:
    """Heights of points over the surface model; those beyond it are left out."""
    path = root / RASTERS["dsm.tif"]
    if not path.is_file():
        return np.zeros(0)
    with rasterio.open(path) as raster:
        place = raster.transform
        columns, rows = (points[:, 0] - place.c) / place.a, (points[:, 1] - place.f) / place.e
        heights = raster.read(1, masked=True).filled(np.nan)
    rows, columns = np.floor(rows).astype(int), np.floor(columns).astype(int)
    inside = (rows >= 0) & (columns >= 0) & (rows < heights.shape[0]) & (columns < heights.shape[1])
    above = points[inside, 2] - heights[rows[inside], columns[inside]]
    return np.asarray(above[np.isfinite(above)], np.float64)


def glb_centre(path: Path) -> Array:
    """The centre of a GLB's CESIUM_RTC."""
    with path.open("rb") as file:
        file.seek(12)
        (length, _) = struct.unpack("<2I", file.read(8))
        document = json.loads(file.read(length))
    if "CESIUM_RTC" not in document.get("extensionsUsed", ()):
        raise ImportFailure("the mesh has no CESIUM_RTC")
    return np.array(document["extensions"]["CESIUM_RTC"]["center"], np.float64)


def check_mesh(path: Path, root: Path, base: Map | None) -> Iterator[Check]:
    """Open the mesh: its place, its textures, and the heights of what faces up against those of the surface model."""
    centre = glb_centre(path)
    parts = list(trimesh.load(path, process=False).geometry.values())
    vertices = np.concatenate([np.asarray(part.vertices) for part in parts]) + centre
    faces = sum(len(part.faces) for part in parts)
    textures = [getattr(part.visual.material, "baseColorTexture", None) for part in parts]
    figure = f"{faces:,} triangles, {[texture.size for texture in textures if texture is not None]}"
    yield Check("the mesh has textures", figure, faces > 0 and all(texture is not None for texture in textures))
    if base is None:
        return
    beyond = base.beyond(vertices)
    yield Check("the mesh lies on the maps", f"{beyond:.2f} px beyond, centre {centre.tolist()}", beyond <= 1.0)
    middles = np.concatenate([np.asarray(part.triangles_center)[part.face_normals[:, 2] > 0.9] for part in parts])
    heights = _over_surface(root, middles + centre)
    middle = float(np.median(np.abs(heights))) if len(heights) else np.nan
    figure = f"median {100.0 * middle:.1f} cm of {len(heights):,} triangles that face up"
    yield Check("the mesh's heights are the surface model's", figure, bool(middle <= base.pixel))


def read_features(path: Path) -> tuple[list[dict[str, Any]], Array, pyproj.CRS]:
    """Properties and positions of a GeoJSON file's points, and its CRS, by pyogrio."""
    meta, _, geometry, fields = pyogrio.raw.read(path)
    rows = [dict(zip(meta["fields"], values, strict=True)) for values in zip(*fields, strict=True)]
    kinds = {geometry_kind(each) for each in geometry}
    if kinds != {1001} and kinds != {1 | 0x80000000}:
        raise ImportFailure(f"{path.name} has geometries that are no points with heights: {kinds}")
    places = np.array([struct.unpack_from("<3d", each, 5) for each in geometry]).reshape(-1, 3)
    return rows, places, pyproj.CRS(meta["crs"])


def geometry_kind(data: bytes) -> int:
    """The type of a geometry in WKB."""
    return int(struct.unpack_from("<I", data, 1)[0])


def listed(value: Any) -> Any:
    """A property that is a list, which GDAL returns as an array or as JSON text."""
    return json.loads(value) if isinstance(value, str) else value


def check_shots(path: Path, _root: Path, base: Map | None) -> Iterator[Check]:
    """Open the photos' places: on the map and in the CRS they must be one."""
    rows, places, crs = read_features(path)
    yield Check("shots have what WebODM reads", f"{len(rows)} photos", all(set(row) >= SHOT_KEYS for row in rows))
    longest = max(float(np.linalg.norm(listed(row["rotation"]))) for row in rows)
    yield Check("rotations are axis times angle", f"at most {longest:.4f} rad", longest <= np.pi + 1e-6)
    if base is None:
        return
    centres = np.array([listed(row["translation"]) for row in rows], np.float64)
    there = np.stack(pyproj.Transformer.from_crs(crs, base.crs, always_xy=True).transform(*places[:, :2].T), axis=1)
    apart = float(np.linalg.norm(there - centres[:, :2], axis=1).max())
    figure = f"at most {1000.0 * apart:.2f} mm apart"
    yield Check("shots: longitude and latitude are the translation", figure, apart <= 0.01)
    metres = pyproj.CRS(base.crs).axis_info[0].unit_conversion_factor
    heights = float(np.abs(places[:, 2] / metres - centres[:, 2]).max())
    yield Check("shots: heights are the translation's", f"at most {1000.0 * heights:.2f} mm apart", heights <= 0.01)


def check_control(path: Path, root: Path, base: Map | None) -> Iterator[Check]:
    """Open the surveyed points: on the map, and, projected by `shots.geojson` and `cameras.json`, at their marks."""
    rows, places, crs = read_features(path)
    if base is None:
        return
    there = np.stack(pyproj.Transformer.from_crs(crs, base.crs, always_xy=True).transform(*places[:, :2].T), axis=1)
    yield Check("surveyed points lie on the maps", f"{base.beyond(there):.2f} px beyond", base.beyond(there) <= 1.0)
    shots = {row["filename"]: row for row in read_features(root / SHOTS)[0]}
    lenses = json.loads((root / "cameras.json").read_text(encoding="utf-8"))
    annotated, reprojected = [], []
    for row, plan, place in zip(rows, there, places, strict=True):
        errors = np.array(listed(row["error"]), np.float64)
        point = np.array([*plan, place[2]]) + errors  # the estimated place, to the few millimetres of the residual
        for seen in listed(row["observations"]):
            shot = shots[seen["shot_id"]]
            side = np.array([shot["width"], shot["height"]], np.float64)
            pixel = project(shot, lenses[shot["camera"]], point)
            annotated.append(np.linalg.norm(pixel - np.array(seen["annotated"]) * side))
            reprojected.append(np.linalg.norm(pixel - np.array(seen["reprojected"]) * side))
    yield Check("marks of surveyed points", f"{len(annotated)} in {len(rows)} points", len(annotated) > 0)
    figure = f"median {np.median(reprojected):.3f} px, at most {max(reprojected):.2f} px from where they project to"
    yield Check("points projected by shots and cameras", figure, max(reprojected) <= MAX_MARK_PX)
    figure = f"median {np.median(annotated):.2f} px, at most {max(annotated):.2f} px from the marks"
    yield Check("points projected beside their marks", figure, float(np.median(annotated)) <= MAX_MARK_PX)


def project(shot: Mapping[str, Any], lens: Mapping[str, Any], point: Array) -> Array:
    """Project a point of the CRS to pixels of a photo, by OpenSfM's documentation of its camera models."""
    rotation = Rotation.from_rotvec(np.array(listed(shot["rotation"]), np.float64))
    x, y, z = rotation.apply(point - np.array(listed(shot["translation"]), np.float64))
    x, y = x / z, y / z
    squared = x * x + y * y
    radial = 1.0 + squared * (lens["k1"] + squared * (lens["k2"] + squared * lens["k3"]))
    bent_x = x * radial + 2.0 * lens["p1"] * x * y + lens["p2"] * (squared + 2.0 * x * x)
    bent_y = y * radial + 2.0 * lens["p2"] * x * y + lens["p1"] * (squared + 2.0 * y * y)
    longer = max(lens["width"], lens["height"])
    return np.array(
        [
            (lens["focal_x"] * bent_x + lens["c_x"]) * longer + lens["width"] / 2,
            (lens["focal_y"] * bent_y + lens["c_y"]) * longer + lens["height"] / 2,
        ]
    )


def check_statistics(path: Path, _root: Path, _base: Map | None) -> Iterator[Check]:
    """Read the figures that WebODM shows."""
    figures = json.loads(path.read_text(encoding="utf-8"))
    gsd, area = figures["odm_processing_statistics"].get("average_gsd"), figures["processing_statistics"].get("area")
    count = figures["reconstruction_statistics"]["reconstructed_points_count"]
    errors = figures.get("gcp_errors", {}).get("average_error")
    text = f"GSD {gsd} cm, {area} m², {count} points, control to {errors} m"
    yield Check("stats.json", text, gsd is not None and count > 0)
