"""A point cloud as LAZ: LAS 1.4 with point format 7, written chunk by chunk in bounded memory (laspy, lazrs).

Colours have 16 bits, as the format requires. Normals are extra bytes with the names of PDAL and CloudCompare, each a
signed byte in steps of 1/127, as Metashape writes them: an error of 0.2° at most, finer than any depth map's, and 2
bytes per point in the file where float32 takes 9 (measured with 3 bytes for the rest). The CRS is WKT of 2001, as the
format requires; what it cannot express about the heights is in a text file beside.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from datetime import date
from pathlib import Path

import laspy
import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8
from laspy.vlrs.known import WktCoordinateSystemVlr
from laspy.vlrs.vlr import VLR

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.durable import whole_file
from splatpipe.pipeline.engine.files.output_file import new_file
from splatpipe.pipeline.surface.rasters.grid import Grid
from splatpipe.pipeline.surface.rasters.map_crs import MapCrs

SCALE = 0.001  # step of coordinates: a millimetre, or a thousandth of a foot
NORMAL_STEPS = 127.0
NORMAL_FIELDS = ("NormalX", "NormalY", "NormalZ")
CONFIDENCE_FIELD = "Confidence"
SIXTEEN_BITS = 257  # 255 becomes 65,535
ROWS = 1 << 18  # points converted at a time
LIMITS_KNOWN = 0b110  # option bits of extra bytes: laspy 2.7 takes the limits from the first point of each chunk only
UNDATED = date(2000, 1, 1)  # the format requires a date, and the same points have to give the same bytes
PROGRAM = "splatpipe"


@dataclass(frozen=True, eq=False)
class CloudChunk:
    """A chunk of points.

    Attributes:
        positions: East, north, up, metres.
        colours: Red, green, blue.
        normals: East, north, up, of unit length; zero where unknown.
        confidence: Number of photos that confirm each point.
        classes: Classes of LAS; None if they are not classified, which is class 0.
    """

    positions: Float64[np.ndarray, "n 3"]
    colours: UInt8[np.ndarray, "n 3"]
    normals: Float32[np.ndarray, "n 3"]
    confidence: UInt8[np.ndarray, " n"]
    classes: UInt8[np.ndarray, " n"] | None = None

    def select(self, rows: slice) -> CloudChunk:
        """The points of these rows."""
        classes = None if self.classes is None else self.classes[rows]
        return CloudChunk(self.positions[rows], self.colours[rows], self.normals[rows], self.confidence[rows], classes)


@dataclass(frozen=True, eq=False)
class CloudFrame:
    """Transformation from a scene's local metres to a cloud's coordinates.

    Attributes:
        crs: CRS of the file.
        crs_from_local: East, north, up (metres) to its coordinates.
        corner: Offset of the file's coordinates: whole numbers near the points.
        middle: Middle of the scene (east, north, up), at which the rotation of directions is taken.
    """

    crs: MapCrs
    crs_from_local: Callable[[Float64[np.ndarray, "n 3"]], Float64[np.ndarray, "n 3"]]
    corner: Float64[np.ndarray, " 3"]
    middle: Float64[np.ndarray, "1 3"]

    @staticmethod
    def of_grid(grid: Grid) -> CloudFrame:
        """The frame of a raster grid that covers the points."""
        west, south, _, _ = grid.bounds
        middle = grid.local_from_cells(np.array([[grid.width / 2.0, grid.height / 2.0, 0.0]]))
        return CloudFrame(grid.crs, grid.crs_from_local, np.array([np.floor(west), np.floor(south), 0.0]), middle)

    @staticmethod
    def of_crs(crs: MapCrs) -> CloudFrame:
        """The frame for points anywhere, with PROJ itself: a few seconds per million points."""
        middle = np.zeros((1, 3))
        corner = np.floor(crs.crs_from_local(middle)[0])
        return CloudFrame(crs, crs.crs_from_local, np.array([corner[0], corner[1], 0.0]), middle)


def write_cloud(path: Path, chunks: Iterable[CloudChunk], frame: CloudFrame, taken_on: date = UNDATED) -> int:
    """Write a cloud; the file is complete, or absent if that fails.

    Args:
        path: Output file, ending in .laz.
        chunks: Consumed one by one.
        frame: Transformation to its CRS.
        taken_on: Date in the file, e.g. that of the photos.

    Returns:
        Number of points.

    Raises:
        SplatpipeError: if a point is not finite, or too far away for the format.
        OSError: if the disk is full or not writable.
    """
    header = _header(frame, taken_on)
    count = 0
    with (
        whole_file(path) as aside,
        new_file(aside) as file,
        laspy.LasWriter(file, header, laz_backend=laspy.LazBackend.Lazrs, closefd=False) as writer,
    ):
        for chunk in _pieces(chunks):
            writer.write_points(_record(chunk, frame, header))
            count += len(chunk.positions)
    return count


def _header(frame: CloudFrame, taken_on: date) -> laspy.LasHeader:
    header = laspy.LasHeader(version="1.4", point_format=7)
    header.scales = np.full(3, SCALE)
    header.offsets = frame.corner
    header.creation_date = taken_on
    header.system_identifier = header.generating_software = PROGRAM
    for name in NORMAL_FIELDS:
        steps = {"scales": np.array([1.0 / NORMAL_STEPS]), "offsets": np.zeros(1)}
        header.add_extra_dim(laspy.ExtraBytesParams(name, "int8", "unit normal", **steps))
    header.add_extra_dim(laspy.ExtraBytesParams(CONFIDENCE_FIELD, "uint8", "photos that confirm it"))
    for field in header.vlrs.get("ExtraBytesVlr")[0].extra_bytes_structs:
        field.options &= ~LIMITS_KNOWN
    header.vlrs.append(WktCoordinateSystemVlr(frame.crs.compound.to_wkt("WKT1_GDAL")))
    header.global_encoding.wkt = True
    about = f"Heights: {frame.crs.described_heights()}".encode() + b"\0"
    header.vlrs.append(VLR("LASF_Spec", 3, "Text area description", about))
    return header


def _pieces(chunks: Iterable[CloudChunk]) -> Iterator[CloudChunk]:
    """These points, at most ``ROWS`` at a time."""
    for chunk in chunks:
        for start in range(0, len(chunk.positions), ROWS):
            yield chunk.select(slice(start, start + ROWS))


def _record(chunk: CloudChunk, frame: CloudFrame, header: laspy.LasHeader) -> laspy.ScaleAwarePointRecord:
    record = laspy.ScaleAwarePointRecord.zeros(len(chunk.positions), header=header)
    steps = _steps(frame.crs_from_local(chunk.positions), header)
    for axis, name in enumerate(("X", "Y", "Z")):
        record[name] = steps[:, axis]
    for band, name in enumerate(("red", "green", "blue")):
        record[name] = chunk.colours[:, band].astype(np.uint16) * SIXTEEN_BITS
    normals = chunk.normals @ _turn(frame).T
    for axis, name in enumerate(NORMAL_FIELDS):
        record.array[name] = np.rint(np.clip(normals[:, axis], -1.0, 1.0) * NORMAL_STEPS).astype(np.int8)
    record.array[CONFIDENCE_FIELD] = chunk.confidence
    if chunk.classes is not None:
        record["classification"] = chunk.classes
    record["return_number"] = np.ones(len(steps), np.uint8)
    record["number_of_returns"] = np.ones(len(steps), np.uint8)
    return record


def _steps(coordinates: Float64[np.ndarray, "n 3"], header: laspy.LasHeader) -> Int64[np.ndarray, "n 3"]:
    steps = np.rint((coordinates - header.offsets) / header.scales)
    if not (np.abs(steps) <= np.iinfo(np.int32).max).all():  # also where it is not a number
        raise SplatpipeError("A point of the cloud is not finite, or beyond what LAS holds.", "Set a --boundary.")
    return np.asarray(steps.astype(np.int64))


def _turn(frame: CloudFrame) -> Float64[np.ndarray, "3 3"]:
    """Rotation of directions from the local frame to the CRS's axes, mainly the grid convergence.

    It is taken at the scene's middle; 3 km away it differs by 0.03°.
    """
    there = frame.crs_from_local(frame.middle + np.concatenate([np.eye(3), -np.eye(3)]))
    derivative = (there[:3] - there[3:]).T * np.array([[frame.crs.unit_m]] * 2 + [[frame.crs.height_unit_m]])
    u, _, vt = np.linalg.svd(derivative)
    return np.asarray(u @ vt)
