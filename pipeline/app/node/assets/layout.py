"""Where each product of a run lies in `all.zip`, and the names under which clients ask for single ones.

Paths and names are ODM's, as WebODM reads them. What ODM does not have keeps its place in OUT. Light to import.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

ALL = "all.zip"
MAX_PATH_LETTERS = 1024
MAX_PATH_DEPTH = 32

ORTHO = "odm_orthophoto/odm_orthophoto.tif"
ORTHO_PICTURE = "odm_orthophoto/odm_orthophoto.png"
CLOUD = "odm_georeferencing/odm_georeferenced_model.laz"
CONTROL = "odm_georeferencing/ground_control_points.geojson"
TEXTURING = "odm_texturing/"
GLB = f"{TEXTURING}odm_textured_model_geo.glb"
OBJ = f"{TEXTURING}odm_textured_model_geo.obj"
MATERIALS = f"{TEXTURING}odm_textured_model_geo.mtl"
SHOTS = "odm_report/shots.geojson"
STATISTICS = "odm_report/stats.json"
CAMERAS = "cameras.json"
LOG = "task_output.txt"


@dataclass(frozen=True)
class Place:
    """The place of a product in `all.zip`.

    Attributes:
        what: What it is, for the log.
        source: Its path in OUT; that of a folder ends in a slash.
        entry: Its path in `all.zip`; likewise.
        stage: The stage that makes it; empty for what is written after the stages.
        format: Its name in the stage's option `formats`; empty if the stage has the option `enabled` instead, or none.
        kind: What it must be to be packed: a map, map tiles or a point cloud that opens; empty for no matter what.
    """

    what: str
    source: str
    entry: str
    stage: str = ""
    format: str = ""
    kind: Literal["", "map", "tiles", "cloud"] = ""


ORTHO_PLACE = Place("orthophoto", "ortho.tif", ORTHO, "ortho", kind="map")
MESH_PLACE = Place("textured mesh", "mesh/mesh.glb", GLB, "mesh")
PLACES = (
    ORTHO_PLACE,
    Place("orthophoto's map tiles", "export/ortho.mbtiles", f"{ORTHO[:-3]}mbtiles", "publish", "mbtiles", "tiles"),
    Place("surface model", "dsm.tif", "odm_dem/dsm.tif", "dsm", kind="map"),
    Place("terrain model", "dtm.tif", "odm_dem/dtm.tif", "dtm", kind="map"),
    Place("surface model's accuracy", "dsm_confidence.tif", "odm_dem/dsm_confidence.tif", "dsm", kind="map"),
    Place("terrain model's accuracy", "dtm_confidence.tif", "odm_dem/dtm_confidence.tif", "dtm", kind="map"),
    Place("heights over the ground", "chm.tif", "odm_dem/chm.tif", "dtm", kind="map"),
    Place("surface model's map tiles", "export/dsm.mbtiles", "odm_dem/dsm.mbtiles", "publish", "mbtiles", "tiles"),
    Place("contours as GeoJSON", "contours.geojson", "contours/contours.geojson", "dtm"),
    Place("contours as DXF", "contours.dxf", "contours/contours.dxf", "dtm"),
    Place("point cloud", "cloud.laz", CLOUD, "cloud", kind="cloud"),
    Place("point cloud in levels", "export/cloud.copc.laz", f"{CLOUD[:-3]}copc.laz", "publish", "copc", "cloud"),
    Place("mesh's 3D Tiles", "export/mesh-tiles/", "3d_tiles/model/", "publish", "mesh-tiles"),
    Place("splat's 3D Tiles", "export/tiles/", "3d_tiles/splat/", "export", "tiles"),
    Place("splat", "splat.ply", "splat.ply", "export"),
    Place("viewer", "viewer.html", "viewer.html", "export"),
    Place("splat's cameras", "cameras.json", "splat_cameras.json", "export"),
    Place("georeference", "georef.json", "georef.json", "export"),
    Place("report", "report.html", "report.html"),
    Place("report as PDF", "report.pdf", "odm_report/report.pdf"),
)
"""Products that are packed as they are; all other deliverables of a run keep their paths, except a mesh's."""

REPLACED = "mesh/"
"""Deliverables in local metres that `all.zip` has in the CRS instead."""

SINGLE = {
    "orthophoto.tif": ORTHO,
    "orthophoto.png": ORTHO_PICTURE,
    "orthophoto.mbtiles": "odm_orthophoto/odm_orthophoto.mbtiles",
    "dsm.tif": "odm_dem/dsm.tif",
    "dtm.tif": "odm_dem/dtm.tif",
    "georeferenced_model.laz": CLOUD,
    "ground_control_points.geojson": CONTROL,
    "textured_model.glb": GLB,
    "report.pdf": "odm_report/report.pdf",
    "shots.geojson": SHOTS,
    "stats.json": STATISTICS,
    "cameras.json": CAMERAS,
    "task_output.txt": LOG,
    "georef.json": "georef.json",
    "splat.ply": "splat.ply",
    "viewer.html": "viewer.html",
    "report.html": "report.html",
}
"""Single files by the names under which they are asked for. They are stored, so that each is a range of `all.zip`."""

FOLDERS = {
    "textured_model.zip": TEXTURING,
    "3d_tiles_model.zip": "3d_tiles/model/",
    "3d_tiles_splat.zip": "3d_tiles/splat/",
}
"""Archives of single folders, made of ranges of `all.zip`."""

COMPRESSED = frozenset(
    f".{ending}"
    for ending in [
        "7z",
        "gif",
        "glb",
        "gz",
        "jpeg",
        "jpg",
        "laz",
        "mbtiles",
        "mp4",
        "pdf",
        "png",
        "rad",
        "sog",
        "spz",
        "tif",
        "webm",
        "webp",
        "zip",
        "zst",
    ]
)
"""Endings of what is compressed already."""

MEDIA_TYPES = {
    ".geojson": "application/geo+json",
    ".glb": "model/gltf-binary",
    ".html": "text/html; charset=utf-8",
    ".json": "application/json",
    ".laz": "application/vnd.laszip",
    ".mbtiles": "application/vnd.sqlite3",
    ".pdf": "application/pdf",
    ".png": "image/png",
    ".tif": "image/tiff",
    ".txt": "text/plain; charset=utf-8",
    ".zip": "application/zip",
}


def is_safe(path: str) -> bool:
    """Whether a path in an archive stays below any folder that it is unpacked into, on every system.

    Args:
        path: POSIX path of a file, or of a folder without its slash at the end.
    """
    if not 0 < len(path) <= MAX_PATH_LETTERS or not path.isprintable() or any(each in path for each in '\\:*?"<>|'):
        return False
    names = path.split("/")
    return len(names) <= MAX_PATH_DEPTH and all(name not in ("", ".", "..") for name in names)


def is_stored(entry: str) -> bool:
    """Whether an entry is stored as it is: it is compressed already, or can be asked for alone."""
    return f".{entry.rpartition('.')[2].lower()}" in COMPRESSED or entry in SINGLE.values()
