"""MBTiles: a map's tiles in one SQLite file, which phones, QGIS and GDAL open offline.

Specification: "MBTiles Specification 1.3" (github.com/mapbox/mbtiles-spec): rows count from the south. Tiles that the
map fills are JPEG, those that it fills partly are PNG, and empty ones are left out; readers look at each tile's bytes.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.engine.files.durable import whole_file
from splatpipe.pipeline.surface.levels.web_mercator import MapTile

JPEG_QUALITY = 88
APPLICATION_ID = 0x4D504258  # "MPBX", by which `file` and others know it
COMMIT_TILES = 4096  # tiles in a transaction
OPAQUE = 255


class TileFile:
    """An MBTiles file that is being written.

    Args:
        database: The open file.
    """

    def __init__(self, database: sqlite3.Connection) -> None:
        self._database = database
        self.count = 0

    def write(self, tile: MapTile, picture: UInt8[np.ndarray, "h w 4"]) -> None:
        """Write a tile once; one without any content is left out.

        Args:
            tile: Its place.
            picture: Red, green, blue, alpha.
        """
        packed = pack_picture(picture)
        if packed is None:
            return
        from_south = (1 << tile.zoom) - 1 - tile.row
        self._database.execute("INSERT INTO tiles VALUES (?, ?, ?, ?)", (tile.zoom, tile.column, from_south, packed))
        self.count += 1
        if self.count % COMMIT_TILES == 0:
            self._database.commit()


@contextmanager
def tile_file(path: Path, facts: Mapping[str, str]) -> Iterator[TileFile]:
    """Write an MBTiles file; it is complete when the block ends, and absent if that fails.

    Args:
        path: Output file.
        facts: The map's metadata.

    Raises:
        MachineError: if the disk is full or not writable.
    """
    with whole_file(path) as aside:
        try:
            with closing(sqlite3.connect(aside)) as database:
                database.execute("PRAGMA journal_mode = OFF")  # a killed run's file is thrown away, not repaired
                database.execute("PRAGMA synchronous = OFF")
                database.execute(f"PRAGMA application_id = {APPLICATION_ID}")
                database.execute("CREATE TABLE metadata (name TEXT, value TEXT)")
                database.execute(
                    "CREATE TABLE tiles (zoom_level INTEGER, tile_column INTEGER, tile_row INTEGER, tile_data BLOB)"
                )
                database.executemany("INSERT INTO metadata VALUES (?, ?)", sorted(facts.items()))
                yield TileFile(database)
                database.execute("CREATE UNIQUE INDEX tile_index ON tiles (zoom_level, tile_column, tile_row)")
                database.commit()
        except sqlite3.Error as error:
            raise MachineError(f"{path} cannot be written: {error}", "Is there space on the disk?") from error


def map_facts(
    name: str, description: str, box: tuple[float, float, float, float], zooms: tuple[int, int]
) -> dict[str, str]:
    """A map's metadata.

    Args:
        name: Its title.
        description: A sentence about it.
        box: West, south, east, north, degrees.
        zooms: The least and the most detailed zoom.
    """
    west, south, east, north = box
    middle = ((west + east) / 2.0, (south + north) / 2.0)
    return {
        "name": name,
        "description": description,
        "format": "jpg",
        "type": "overlay",
        "version": "1.3",
        "bounds": ",".join(f"{value:.12f}" for value in box),
        "center": f"{middle[0]:.9f},{middle[1]:.9f},{max(zooms[0], zooms[1] - 3)}",
        "minzoom": str(zooms[0]),
        "maxzoom": str(zooms[1]),
        "generator": "splatpipe",
    }


def pack_picture(picture: UInt8[np.ndarray, "h w 4"]) -> bytes | None:
    """A picture as JPEG if it is opaque, else as PNG; None if nothing is in it."""
    alpha = picture[..., 3]
    if not alpha.any():
        return None
    if (alpha == OPAQUE).all():
        done, data = cv2.imencode(".jpg", picture[..., 2::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    else:
        done, data = cv2.imencode(".png", picture[..., [2, 1, 0, 3]])
    if not done:
        raise MachineError("A map's tile could not be packed.", "Is there enough memory?")
    return bytes(data)
