"""Read a run's surface products, or anyone's files, and transform them from their frames to the truth's.

``facades.json`` is a list (or an object with the list under ``facades``) of objects with ``name``, ``corners`` (upper
left, upper right, lower right, lower left; three coordinates of the CRS each), ``depth`` (a TIFF of metres before the
plane, towards the viewer) and ``picture`` (file names beside it).
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pycolmap
import pyproj
import rasterio
import rasterio.errors
import trimesh
from jaxtyping import Bool, Float64, UInt8

from splatpipe.demo import CAPTURE
from splatpipe.demo.truth.truth import truth_from_model
from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.engine.runs.run_folder import open_run_folder
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.survey.crs.frames import Frame, Origin, load_frame
from splatpipe.pipeline.survey.crs.world import World, open_world
from splatpipe.stages.line import EVALUATE, EXPORT, GEOREF, LINE, TRAIN

Points = Float64[np.ndarray, "n 3"]
FILES = {
    "dsm": ("dsm.tif",),
    "ortho": ("ortho.tif",),
    "facades": ("facades.json",),
    "mesh": ("mesh.ply", "mesh.glb"),
    "cloud": ("cloud.laz", "cloud.las", "cloud.ply"),
}
FOLDERS = (".", "surface", "products", "facades", "mesh")
ELLIPSOIDAL = "ellipsoidal"
Z_UP_FROM_GLB = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # glTF is y up


@dataclass(frozen=True, eq=False)
class Raster:
    """A GeoTIFF raster.

    Attributes:
        bands: (bands, h, w), as stored.
        there: Mask of valid data.
        affine: From column, row to the CRS: (2, 3).
        crs: As ``parse_crs`` takes it.
    """

    bands: np.ndarray
    there: Bool[np.ndarray, "h w"]
    affine: Float64[np.ndarray, "2 3"]
    crs: str

    @property
    def cell(self) -> float:
        """Return the side of a cell, units of the CRS."""
        return float(np.hypot(self.affine[0, 0], self.affine[1, 0]))

    def to_grid(self, coordinates: Points) -> Points:
        """Transform coordinates of the CRS to column, row and height."""
        plan = np.linalg.solve(self.affine[:, :2], (coordinates[:, :2] - self.affine[:, 2]).T).T
        return np.column_stack([plan, coordinates[:, 2]])

    def from_grid(self, places: Points) -> Points:
        """Transform column, row and height to coordinates of the CRS."""
        return np.column_stack([places[:, :2] @ self.affine[:, :2].T + self.affine[:, 2], places[:, 2]])


def read_raster(path: Path) -> Raster:
    """Read a GeoTIFF; NaN is no data, whatever the file declares."""
    with rasterio.open(path) as held:
        bands, there = held.read(), held.dataset_mask() > 0
        if held.crs is None:
            raise UsageError(f"{path} has no CRS.")
        at, crs = held.transform, plan_crs(held.crs.to_wkt())
    if np.issubdtype(bands.dtype, np.floating):
        there &= np.isfinite(bands[0])
    return Raster(bands, there, np.array([[at.a, at.b, at.c], [at.d, at.e, at.f]]), crs)


def plan_crs(wkt: str) -> str:
    """Return the EPSG code of a CRS's horizontal part; its whole text if it has none."""
    crs = pyproj.CRS.from_wkt(wkt)
    plan = (crs.sub_crs_list[0] if crs.is_compound else crs).to_2d()
    code = plan.to_epsg()
    return f"EPSG:{code}" if code else wkt


def colours(raster: Raster) -> UInt8[np.ndarray, "h w 3"]:
    """Return an image's colours, black where it is empty."""
    picture = np.moveaxis(raster.bands[:3], 0, -1).astype(np.uint8)
    return np.where(raster.there[..., None], picture, 0).astype(np.uint8)


@dataclass(frozen=True)
class ProductTransform:
    """Transforms between a product's coordinates and the truth's local metres.

    Attributes:
        truth: The truth's own frame, with coordinates in the CRS.
        run: The run's frame, likewise; the truth's for files without a run.
        laid_over: From the run's local frame to the truth's, if the run is to be aligned to the truth by its cameras.
    """

    truth: World
    run: World
    laid_over: Similarity | None

    def true_from_local(self, points: Points) -> Points:
        """Transform the run's local metres to the truth's."""
        if self.laid_over is not None:
            return self.laid_over.apply(points)
        return self.truth.local_from_crs(self.run.crs_from_local(points))

    def true_from_crs(self, points: Points) -> Points:
        """Transform coordinates of the CRS to the truth's local metres."""
        return self.true_from_local(self.run.local_from_crs(points))

    def crs_from_true(self, points: Points) -> Points:
        """Transform the truth's local metres to coordinates of the CRS."""
        if self.laid_over is not None:
            return self.run.crs_from_local(self.laid_over.inverse().apply(points))
        return self.truth.crs_from_local(points)


def true_frame(crs: str) -> Frame:
    """Return the frame of the truth, with coordinates in a CRS."""
    origin = json.loads((CAPTURE / "truth.json").read_text(encoding="utf-8"))["frame"]["origin"]
    return Frame("enu", Similarity.identity(), Origin(**origin), ELLIPSOIDAL, crs=crs)


def frames_of(out: Path, crs: str, align: str) -> ProductTransform:
    """Return the transforms of a run's products, or of files in another folder, whose local frame is then the truth's.

    Args:
        out: OUT.
        crs: CRS of the products.
        align: ``none``: as delivered. ``cameras``: aligned to the truth by the run's camera centres.
    """
    truth = open_world(true_frame(crs))
    parts = _parts(out)
    if "georef.frame" not in parts:
        if align != "none":
            raise UsageError(f"{out} has no cameras to lay it over the truth by.")
        return ProductTransform(truth, truth, None)
    frame = load_frame(parts["georef.frame"].path)
    run = open_world(Frame(frame.kind, frame.world_from_model, frame.origin, frame.vertical_datum, crs=crs))
    if align == "none":
        return ProductTransform(truth, run, None)
    model = pycolmap.Reconstruction(parts["georef.model"].path)
    poses = {
        image.name: np.vstack([image.cam_from_world().matrix(), [0.0, 0.0, 0.0, 1.0]])
        for image in model.images.values()
        if image.has_pose
    }
    return ProductTransform(truth, run, truth_from_model(poses).compose(frame.world_from_model.inverse()))


def _parts(out: Path) -> dict[str, Any]:
    if not (out / "stages").is_dir():
        return {}
    return open_run_folder(out, LINE).lineage(EXPORT, EVALUATE, TRAIN, GEOREF)


def find_products(out: Path) -> dict[str, Path]:
    """Return the paths of the existing products."""
    found = {}
    for product, names in FILES.items():
        places = (out / folder / name for folder in FOLDERS for name in names)
        path = next((place for place in places if place.is_file()), None)
        if path is not None:
            found[product] = path
    return found


def read_mesh(path: Path) -> Float64[np.ndarray, "m 3 3"]:
    """Read the corners of a mesh's triangles, local metres, z up."""
    corners = np.asarray(trimesh.load(path, force="mesh").triangles, np.float64)
    return corners @ Z_UP_FROM_GLB.T if path.suffix == ".glb" else corners


def read_cloud(path: Path, from_crs: Callable[[Points], Points], from_local: Callable[[Points], Points]) -> Points:
    """Read a cloud's points: LAZ is in the CRS, PLY in local metres."""
    if path.suffix == ".ply":
        return from_local(np.asarray(trimesh.load(path).vertices, np.float64))
    return from_crs(np.asarray(laspy.read(path).xyz, np.float64))


@dataclass(frozen=True, eq=False)
class Facade:
    """A façade elevation.

    Attributes:
        name: The run's name for it.
        corners: Upper left, upper right, lower right, lower left; truth's local metres: (4, 3).
        depth: Metres in front of the plane, NaN where missing; (h, w).
    """

    name: str
    corners: Float64[np.ndarray, "4 3"]
    depth: Float64[np.ndarray, "h w"]

    def axes(self) -> tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, " 3"], Float64[np.ndarray, " 3"]]:
        """Return the steps of a column and of a row (metres each), and the unit normal towards the viewer."""
        height, width = self.depth.shape
        right, down = (self.corners[1] - self.corners[0]) / width, (self.corners[3] - self.corners[0]) / height
        normal = np.cross(down, right)
        return right, down, normal / np.linalg.norm(normal)

    def points(self) -> Points:
        """Return the positions of the cells that have a depth."""
        right, down, normal = self.axes()
        row, column = np.nonzero(np.isfinite(self.depth))
        on_plane = self.corners[0] + (column + 0.5)[:, None] * right + (row + 0.5)[:, None] * down
        return np.asarray(on_plane + self.depth[row, column, None] * normal)


def open_plain(path: Path) -> rasterio.DatasetReader:
    """Open a TIFF that may lack a georeference."""
    warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
    return rasterio.open(path)


def read_facades(path: Path, from_crs: Callable[[Points], Points]) -> list[Facade]:
    """Read the elevations listed in a ``facades.json``.

    Raises:
        UsageError: if it is invalid.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        facades = []
        for each in data["facades"] if isinstance(data, dict) else data:
            with warnings.catch_warnings(), open_plain(path.parent / each["depth"]) as held:
                depth, there = held.read(1).astype(np.float64), held.dataset_mask() > 0
            corners = from_crs(np.array(each["corners"], np.float64).reshape(4, 3))
            facades.append(Facade(str(each["name"]), corners, np.where(there, depth, np.nan)))
        return facades
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(f"{path} is not understood: {error}") from error
