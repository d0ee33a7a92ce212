"""Convert a georeferenced scene's local metres into a CRS, and place the scene on the earth.

The exact path is local → earth-centred (ECEF) by one float64 4×4 → latitude, longitude, height → CRS by PROJ; projected
coordinates are never float32. Heights stay as stated: where their datum is not the ellipsoid, the 4×4 of that path
still treats them as ellipsoidal, so that they come back as stated. The matrix that places the scene on the earth is a
separate one, raised by the geoid where its grid is installed and labelled approximate where it is not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.survey.crs.crs import (
    ELLIPSOIDAL,
    UNKNOWN,
    Crs,
    Operation,
    describe_vertical,
    from_geodetic,
    geodetic_by,
    open_operation,
    parse_crs,
    same_datum,
    undulation,
    usable_for_maps,
    utm_of,
)
from splatpipe.pipeline.survey.crs.frames import Frame
from splatpipe.pipeline.survey.crs.geodesy import Origin, ecef_from_geodetic

STEP_M = 100.0  # step of the central differences: their third-order error is 1e-12 of a length, float64's is 1e-11
BOX_STEPS = 9  # samples along each side of the scene: errors are quadratic, so largest at its edges
AUTO = "auto"


@dataclass(frozen=True)
class Placement:
    """The rigid 4×4 that places the local frame on the earth (EPSG:4978), a 3D Tiles root transform.

    Attributes:
        matrix: From local to ECEF, metres.
        approximate: Whether its heights may be off because the datum or the geoid's grid is missing.
        largest_error_m: Against the exact path over the scene; None where unknown.
        note: The reason, a sentence or two.
    """

    matrix: Float64[np.ndarray, "4 4"]
    approximate: bool
    largest_error_m: float | None
    note: str


@dataclass(frozen=True)
class Tangent:
    """The best affine map from local to CRS about the origin, for programs that take only a matrix.

    Attributes:
        matrix: From local metres to the CRS's units; float64 is needed.
        largest_error_m: Horizontally, over the scene, against the exact path.
        largest_height_error_m: The same for heights: the earth's curvature.
    """

    matrix: Float64[np.ndarray, "4 4"]
    largest_error_m: float
    largest_height_error_m: float


@dataclass(frozen=True)
class GridScale:
    """The scale of lengths in a projected CRS, at the origin.

    Attributes:
        projection: Grid length over length on the ellipsoid.
        ground: Grid length over length on the ground at the origin's height: projection factor times height factor.
        convergence_deg: Meridian convergence: from true to grid north, clockwise.
    """

    projection: float
    ground: float
    convergence_deg: float


@dataclass(frozen=True)
class World:
    """A local frame and the CRS of its output coordinates.

    Attributes:
        origin: Of the local east-north-up frame.
        vertical: Datum of the local heights.
        crs: Of the coordinates.
        operation: Between the CRS and WGS 84.
    """

    origin: Origin
    vertical: str
    crs: Crs
    operation: Operation

    @property
    def heights(self) -> str:
        """Vertical datum of output heights: the CRS's, or that of the local heights."""
        return self.vertical if self.crs.vertical == UNKNOWN else self.crs.vertical

    def crs_from_local(self, local: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Convert east, north, up (metres) to easting (longitude), northing (latitude), height in the CRS's units."""
        geodetic = self.origin.geodetic_from_enu(local)
        geodetic[:, 2] += self._raise(geodetic)
        return from_geodetic(self.operation, self.crs, geodetic)

    def local_from_crs(self, coordinates: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Convert CRS coordinates to east, north, up (metres): the exact inverse of ``crs_from_local``."""
        geodetic = geodetic_by(self.operation, self.crs, coordinates)
        geodetic[:, 2] -= self._raise(geodetic)
        return self.origin.enu_from_geodetic(geodetic)

    def _raise(self, geodetic: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
        """Heights in the CRS less the local ones (metres)."""
        if self.heights == self.vertical or same_datum(self.heights, self.vertical):
            return np.zeros(len(geodetic))
        place = geodetic[:, 0], geodetic[:, 1]
        return np.asarray(undulation(self.vertical, *place) - undulation(self.heights, *place))

    def placement(self, box: Float64[np.ndarray, "2 3"]) -> Placement:
        """The local frame's placement on the earth.

        Args:
            box: Least and largest east, north, up of the scene, metres.
        """
        if self.vertical == ELLIPSOIDAL:
            return Placement(self.origin.ecef_from_enu(), False, 0.0, "")
        if self.vertical == UNKNOWN:
            note = "The vertical datum is not known: heights are treated as ellipsoidal, and may be tens of metres off."
            return Placement(self.origin.ecef_from_enu(), True, None, note)
        samples = _samples(box)
        geodetic = self.origin.geodetic_from_enu(samples)
        try:
            raised = undulation(self.vertical, np.array([self.origin.latitude]), np.array([self.origin.longitude]))
            geodetic[:, 2] += undulation(self.vertical, geodetic[:, 0], geodetic[:, 1])
        except SplatpipeError as error:
            note = f"Heights are treated as ellipsoidal, and may be tens of metres off. {error.message}"
            return Placement(self.origin.ecef_from_enu(), True, None, note)
        matrix = replace(self.origin, height_m=self.origin.height_m + float(raised[0])).ecef_from_enu()
        off = samples @ matrix[:3, :3].T + matrix[:3, 3] - ecef_from_geodetic(geodetic)
        note = f"Raised by the geoid of {describe_vertical(self.vertical)} at the origin, {raised[0]:.3f} m."
        return Placement(matrix, False, _longest(off), note)

    def tangent(self, box: Float64[np.ndarray, "2 3"]) -> Tangent:
        """The matrix closest to the exact path at the origin, and its largest errors over the scene.

        Args:
            box: Least and largest east, north, up of the scene, metres.
        """
        matrix = np.eye(4)
        matrix[:3, :3] = self._derivative()
        matrix[:3, 3] = self.crs_from_local(np.zeros((1, 3)))[0]
        samples = _samples(box)
        back = self.local_from_crs(samples @ matrix[:3, :3].T + matrix[:3, 3])
        off = back - samples
        return Tangent(matrix, _longest(off[:, :2]), _longest(off[:, 2:]))

    def grid_scale(self) -> GridScale | None:
        """Scale of lengths in the CRS against the ground; None in a geographic CRS, which has no lengths."""
        if self.crs.is_geographic:
            return None
        on_ellipsoid = replace(self, origin=replace(self.origin, height_m=0.0))
        projected, grounded = (world._derivative()[:2, :2] * self.crs.unit_m for world in (on_ellipsoid, self))
        convergence = -math.degrees(math.atan2(grounded[0, 1], grounded[1, 1]))
        return GridScale(_scale(projected), _scale(grounded), convergence)

    def _derivative(self) -> Float64[np.ndarray, "3 3"]:
        steps = STEP_M * np.concatenate([np.eye(3), -np.eye(3)])
        there = self.crs_from_local(steps)
        return np.asarray((there[:3] - there[3:]).T / (2.0 * STEP_M))


def open_world(frame: Frame) -> World:
    """The world of a georeferenced frame.

    Raises:
        SplatpipeError: if its CRS cannot be used there: as ``open_operation``, and where its heights cannot be
            converted to the CRS's datum.
        ValueError: if the frame is arbitrary.
    """
    if frame.origin is None:
        raise ValueError("an arbitrary frame lies nowhere")
    origin = frame.origin
    crs = parse_crs(frame.crs) if frame.crs else utm_of(origin.latitude, origin.longitude)
    operation = open_operation(crs, origin.latitude, origin.longitude, frame.approximate_crs)
    world = World(origin, frame.vertical_datum, crs, operation)
    world.crs_from_local(np.zeros((1, 3)))  # fails now if the geoid's grids are missing
    return world


def in_crs(frame: Frame, asked: str, stated: str = "", approximate: bool = False) -> Frame:
    """Set the CRS of a frame's output coordinates, after checking that it can be used.

    Args:
        frame: Georeferenced; an arbitrary one is returned unchanged.
        asked: `georef.crs`; ``auto`` for the control file's, or the UTM zone where its heights are not the frame's.
        stated: The control file's; empty without one.
        approximate: `georef.approximate_crs`.

    Raises:
        SplatpipeError: as ``open_world``.
    """
    if frame.origin is None:
        return frame
    crs = utm_of(frame.origin.latitude, frame.origin.longitude) if asked == AUTO else parse_crs(asked)
    if asked == AUTO and stated:
        theirs = parse_crs(stated)
        crs = theirs if theirs.vertical == UNKNOWN or same_datum(theirs.vertical, frame.vertical_datum) else crs
    placed = replace(frame, crs=crs.text, approximate_crs=approximate)
    open_world(placed)
    return placed


def report_map_crs(frame: Frame, asked: bool, report: Reporter) -> None:
    """Tell where the frame's CRS suits points but no rasters, so that survey files are in another one.

    Args:
        frame: Georeferenced; nothing is told of an arbitrary one.
        asked: Whether the CRS was asked for; degrees of a control file are not expected of rasters.
        report: Receives the warning or note.
    """
    if frame.origin is None or not frame.crs:
        return
    crs = parse_crs(frame.crs)
    if usable_for_maps(crs):
        return
    utm = utm_of(frame.origin.latitude, frame.origin.longitude)
    instead = f"Orthophoto, elevation models, contours, point cloud and plans are in {utm.text} ({utm.name}) instead"
    if not crs.is_geographic:
        report.warning(
            f"{crs.text} ({crs.name}) counts to the west or south, which would turn rasters round. {instead}.",
            "Choose its east-north form, if there is one (EPSG:5514 for Krovak), with --set georef.crs=EPSG:n.",
        )
    elif asked:
        report.note(f"{crs.text} ({crs.name}) is in degrees, which rasters cannot be. {instead}.")


def _samples(box: Float64[np.ndarray, "2 3"]) -> Float64[np.ndarray, "n 3"]:
    sides = [np.linspace(box[0, axis], box[1, axis], BOX_STEPS) for axis in range(3)]
    return np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3)


def _scale(derivative: Float64[np.ndarray, "2 2"]) -> float:
    return math.sqrt(abs(float(np.linalg.det(derivative))))


def _longest(vectors: Float64[np.ndarray, "n k"]) -> float:
    return float(np.linalg.norm(vectors, axis=1).max())
