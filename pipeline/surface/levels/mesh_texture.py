"""The textures of a part of a mesh: each chart's piece of its page, reduced, packed into one picture."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, Int64, UInt8
from numpy.lib.format import open_memmap

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.surface.levels.charted_mesh import ChartedMesh

MARGIN = 1  # reduced pixels around a chart's piece that are its own, for a viewer's interpolation
GUTTER = 1  # and that repeat its border, for a viewer's coarser copies
JPEG_QUALITY = 85
MAX_SIDE = 4096  # pixels: what every phone's GPU takes


class TexturePages:
    """Texture pages, decoded into files that are read in parts, so that memory does not depend on their size.

    Args:
        pages: Their images.
        folder: For the decoded files; it is made, and emptied by ``remove``.

    Raises:
        SplatpipeError: if a page cannot be decoded.
        OSError: if the disk is full.
    """

    def __init__(self, pages: Sequence[Path], folder: Path) -> None:
        self._folder = folder
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        self._decoded = [self._decode(path, number) for number, path in enumerate(pages)]

    def _decode(self, path: Path, number: int) -> UInt8[np.ndarray, "h w 3"]:
        picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if picture is None:
            raise SplatpipeError(f"{path.name} cannot be read.", "Make it again with --rerun mesh.")
        path = self._folder / f"{number}.npy"
        np.save(path, picture)
        return np.asarray(open_memmap(path, "r"))  # what was written is not mapped: it would count as memory

    def __getitem__(self, page: int) -> UInt8[np.ndarray, "h w 3"]:
        """A page: blue, green, red."""
        return self._decoded[page]

    def remove(self) -> None:
        """Remove the decoded files."""
        self._decoded.clear()
        shutil.rmtree(self._folder, ignore_errors=True)


@dataclass(frozen=True, eq=False)
class PackedTexture:
    """A texture for a part of a mesh.

    Attributes:
        jpeg: The picture as JPEG.
        size: Its width and height, pixels.
        uv: Place of each triangle's corners in it, 0 to 1 from its upper left corner, as in glTF.
    """

    jpeg: bytes
    size: tuple[int, int]
    uv: Float32[np.ndarray, "m 3 2"]


@dataclass(frozen=True, eq=False)
class _Pieces:
    """The pieces of pages that a part of a mesh needs.

    Attributes:
        charts: Charts, sorted; the others have a row for each.
        origins: Column and row of the piece's upper left corner in the page.
        sizes: Width and height in reduced pixels, without gutter.
    """

    charts: Int64[np.ndarray, " c"]
    origins: Int64[np.ndarray, "c 2"]
    sizes: Int64[np.ndarray, "c 2"]


def packed_texture(
    mesh: ChartedMesh, rects: Int64[np.ndarray, "c 5"], pages: TexturePages, factor: int
) -> PackedTexture:
    """Cut out and reduce what a part of a mesh shows of its pages.

    Args:
        mesh: At least one triangle.
        rects: Page, left, top, width, height of each chart in full pixels; nothing else is in them.
        pages: The pages.
        factor: Full pixels per pixel, per side, a whole number; it is doubled until the picture is small enough.
    """
    while True:
        pieces = _pieces(mesh, rects, factor)
        places, size = pack(pieces.sizes + 2 * GUTTER)
        if max(size) <= MAX_SIDE:
            break
        factor *= 2
    picture = np.full((size[1], size[0], 3), 128, np.uint8)
    for chart, origin, (wide, high), (left, top) in zip(
        pieces.charts.tolist(), pieces.origins.tolist(), pieces.sizes.tolist(), places.tolist(), strict=True
    ):
        piece = _reduced(pages, rects[chart], origin, (wide, high), factor)
        gutter = cv2.copyMakeBorder(piece, GUTTER, GUTTER, GUTTER, GUTTER, cv2.BORDER_REPLICATE)
        picture[top : top + high + 2 * GUTTER, left : left + wide + 2 * GUTTER] = gutter
    row = np.searchsorted(pieces.charts, mesh.charts)
    inside = (mesh.corners - pieces.origins[row][:, None]) / factor + places[row][:, None] + GUTTER
    done, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise SplatpipeError("A tile's texture could not be packed.", "Is there enough memory?")
    return PackedTexture(data.tobytes(), size, (inside / np.array(size)).astype(np.float32))


def _pieces(mesh: ChartedMesh, rects: Int64[np.ndarray, "c 5"], factor: int) -> _Pieces:
    charts, row = np.unique(mesh.charts, return_inverse=True)
    low, high = np.full((len(charts), 2), np.inf), np.full((len(charts), 2), -np.inf)
    for corner in range(3):
        np.minimum.at(low, row.ravel(), mesh.corners[:, corner])
        np.maximum.at(high, row.ravel(), mesh.corners[:, corner])
    start = rects[charts, 1:3]
    end = start + rects[charts, 3:5]
    origins = np.clip(np.floor(low).astype(np.int64) - MARGIN * factor, start, end - 1)
    ends = np.clip(np.ceil(high).astype(np.int64) + MARGIN * factor, origins + 1, end)
    return _Pieces(charts, origins, -(-(ends - origins) // factor))


def _reduced(
    pages: TexturePages, rect: Int64[np.ndarray, " 5"], origin: Sequence[int], size: tuple[int, int], factor: int
) -> UInt8[np.ndarray, "h w 3"]:
    """A piece of a page at a fraction of its size; beyond the chart's rectangle its border is repeated."""
    page, left, top, width, height = (int(value) for value in rect)
    column, row = origin
    wide, high = size[0] * factor, size[1] * factor
    found = np.array(pages[page][row : min(row + high, top + height), column : min(column + wide, left + width)])
    if factor == 1:
        return found
    whole = cv2.copyMakeBorder(found, 0, high - found.shape[0], 0, wide - found.shape[1], cv2.BORDER_REPLICATE)
    return np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_AREA), np.uint8)


def pack(sizes: Int64[np.ndarray, "c 2"]) -> tuple[Int64[np.ndarray, "c 2"], tuple[int, int]]:
    """Pack rectangles in rows, the highest first.

    Args:
        sizes: Width and height of each.

    Returns:
        Column and row of each, and width and height of the whole.
    """
    area = float((sizes[:, 0] * sizes[:, 1]).sum())
    width = max(int(np.ceil(np.sqrt(1.05 * area))), int(sizes[:, 0].max()))
    places = np.zeros_like(sizes)
    left = top = row_height = 0
    for number in np.lexsort((np.arange(len(sizes)), -sizes[:, 0], -sizes[:, 1])).tolist():
        wide, high = (int(value) for value in sizes[number])
        if left + wide > width:
            left, top, row_height = 0, top + row_height, 0
        places[number] = left, top
        left, row_height = left + wide, max(row_height, high)
    return places, (width, top + row_height)
