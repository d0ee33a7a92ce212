"""The tiles of web maps: squares of 256 pixels in Web Mercator (EPSG:3857), each divided into four on the next zoom.

Specification: "WMTS Simple Profile", WorldWebMercatorQuad (OGC 17-083r4, annex E): rows count from the north. Web
Mercator is a sphere's projection of latitudes and longitudes of the WGS 84 ellipsoid.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.surface.rasters.map_crs import MapCrs

SIDE = 256  # pixels of a tile, per side
RADIUS_M = 6378137.0
WORLD_M = 2.0 * math.pi * RADIUS_M  # side of the one tile of zoom 0, at the equator
MAX_ZOOM = 24
_KNOTS = 9  # per side of a tile: positions in a raster are exact there and linear between them

Geodetic = Float64[np.ndarray, "n 3"]


@dataclass(frozen=True)
class MapTile:
    """A tile of a web map.

    Attributes:
        zoom: 0 is the whole world.
        column: From the antimeridian to the east.
        row: From the north.
    """

    zoom: int
    column: int
    row: int

    def children(self) -> tuple[MapTile, MapTile, MapTile, MapTile]:
        """Its quarters, row by row."""
        zoom, column, row = self.zoom + 1, 2 * self.column, 2 * self.row
        return (
            MapTile(zoom, column, row),
            MapTile(zoom, column + 1, row),
            MapTile(zoom, column, row + 1),
            MapTile(zoom, column + 1, row + 1),
        )

    def pixels_from_tile(self, inside: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]:
        """Pixels of the whole map at this zoom, from pixels of this tile."""
        return np.asarray(inside + SIDE * np.array([self.column, self.row], np.float64))


def geodetic_from_pixels(pixels: Float64[np.ndarray, "n 2"], zoom: int, height_m: float) -> Geodetic:
    """Latitude, longitude (degrees) and a given height of pixels of the map at a zoom."""
    share = pixels / (SIDE << zoom)
    longitude = 360.0 * share[:, 0] - 180.0
    latitude = np.degrees(np.arctan(np.sinh(math.pi * (1.0 - 2.0 * share[:, 1]))))
    return np.stack([latitude, longitude, np.full(len(pixels), height_m)], axis=1)


def pixels_from_geodetic(geodetic: Geodetic, zoom: int) -> Float64[np.ndarray, "n 2"]:
    """The inverse of ``geodetic_from_pixels``."""
    across = (geodetic[:, 1] + 180.0) / 360.0
    down = 0.5 - np.arcsinh(np.tan(np.radians(geodetic[:, 0]))) / (2.0 * math.pi)
    return np.stack([across, down], axis=1) * (SIDE << zoom)


def pixel_m(zoom: int, latitude: float) -> float:
    """Size of a pixel on the ground, metres."""
    return WORLD_M / (SIDE << zoom) * math.cos(math.radians(latitude))


@dataclass(frozen=True, eq=False)
class MapPlace:
    """A raster's place on the web's map.

    Attributes:
        crs: CRS of the raster.
        cells_from_crs: From the CRS to the raster's columns and rows.
        box: West, south, east, north of the raster, degrees.
        latitude: Of its middle, degrees.
    """

    crs: MapCrs
    cells_from_crs: Callable[[Float64[np.ndarray, "n 2"]], Float64[np.ndarray, "n 2"]]
    box: tuple[float, float, float, float]
    latitude: float

    @property
    def height_m(self) -> float:
        """Height at which places are converted: that of the run's origin, as it hardly matters."""
        return 0.0 if self.crs.world is None else self.crs.world.origin.height_m

    def cells(self, tile: MapTile, margin: int) -> Float64[np.ndarray, "h w 2"]:
        """Columns and rows of the raster at the centres of a tile's pixels and of some around it.

        Args:
            tile: The tile.
            margin: Pixels around it.
        """
        whole = SIDE + 2 * margin
        knots = np.linspace(0.5 - margin, SIDE + margin - 0.5, _KNOTS)
        at = np.stack(np.meshgrid(knots, knots), axis=-1).reshape(-1, 2)
        geodetic = geodetic_from_pixels(tile.pixels_from_tile(at), tile.zoom, self.height_m)
        cells = self.cells_from_crs(crs_from_geodetic(self.crs, geodetic)[:, :2]).reshape(_KNOTS, _KNOTS, 2)
        share = np.linspace(0.0, _KNOTS - 1.0, whole)
        low = np.minimum(share.astype(int), _KNOTS - 2)
        part = (share - low)[:, None, None]
        rows = cells[low] * (1.0 - part) + cells[low + 1] * part
        part = part.transpose(1, 0, 2)
        return np.asarray(rows[:, low] * (1.0 - part) + rows[:, low + 1] * part)

    def tiles(self, zoom: int) -> Iterator[MapTile]:
        """All tiles of a zoom that the raster touches, row by row."""
        west, south, east, north = self.box
        corners = pixels_from_geodetic(np.array([[north, west, 0.0], [south, east, 0.0]]), zoom)
        (left, top), (right, bottom) = np.floor(corners / SIDE).astype(int).tolist()
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                yield MapTile(zoom, column, row)

    def whole_pixels(self, zoom: int) -> tuple[float, float, float, float]:
        """West, south, east, north of the pixels of a zoom that the raster touches, degrees.

        GDAL and QGIS place a map by such a box, pixel by pixel from its corner, instead of by its tiles.
        """
        west, south, east, north = self.box
        corners = pixels_from_geodetic(np.array([[north, west, 0.0], [south, east, 0.0]]), zoom)
        outer = np.stack([np.floor(corners[0]), np.ceil(corners[1])])
        (top, left, _), (bottom, right, _) = geodetic_from_pixels(outer, zoom, 0.0).tolist()
        return left, bottom, right, top

    def touches(self, tile: MapTile) -> bool:
        """Whether a tile shows any of the raster."""
        west, south, east, north = self.box
        corners = pixels_from_geodetic(np.array([[north, west, 0.0], [south, east, 0.0]]), tile.zoom) / SIDE
        at = np.array([tile.column, tile.row])
        return bool((at < corners[1]).all() and (at + 1 > corners[0]).all())


def crs_from_geodetic(crs: MapCrs, geodetic: Geodetic) -> Float64[np.ndarray, "n 3"]:
    """Eastings, northings, heights of a georeferenced CRS from WGS 84, by the run's own transformation."""
    assert crs.world is not None
    return crs.crs_from_local(crs.world.origin.enu_from_geodetic(geodetic))


def geodetic_from_crs(crs: MapCrs, coordinates: Float64[np.ndarray, "n 3"]) -> Geodetic:
    """The inverse of ``crs_from_geodetic``."""
    assert crs.world is not None
    return crs.world.origin.geodetic_from_enu(crs.local_from_crs(coordinates))
