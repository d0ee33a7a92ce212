"""The part of a photo that an iteration trains on: how often the photo is halved, and which window of it counts.

Windows are the cells of a grid over the photo. Their borders are placed so that a window grown by the reach of SSIM
begins on a node of the sky's grid: values interpolated between nodes are then the same in a window as in the whole.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

REACH_PX = 5  # half of SSIM's window, which reaches this far over a border
NODES_PX = 8  # node spacing: the panorama's `STEP_PX`
MIN_SIDE_PX = 2 * NODES_PX  # side of a cell: borders move by at most half the node spacing
MAX_OBLONG = 2.5  # aspect ratio of a cell: the borders of strips cost more than a few extra cells


@dataclass(frozen=True)
class TrainingSize:
    """A size to train at.

    Attributes:
        level: Number of times the photo is halved.
        window_pixels: Most pixels of the halved photo that count in an iteration; 0 for all of it, however large.
    """

    level: int = 0
    window_pixels: int = 0


@dataclass(frozen=True)
class PixelRectangle:
    """A rectangle in an image, pixels.

    Attributes:
        left: First column.
        top: First row.
        right: One past the last column.
        bottom: One past the last row.
    """

    left: int
    top: int
    right: int
    bottom: int

    @property
    def width(self) -> int:
        """Number of columns."""
        return self.right - self.left

    @property
    def height(self) -> int:
        """Number of rows."""
        return self.bottom - self.top

    @property
    def pixels(self) -> int:
        """Number of pixels."""
        return self.width * self.height

    def grown(self, width: int, height: int) -> PixelRectangle:
        """The rectangle grown by the reach of SSIM, clipped to the image.

        Args:
            width: Width of the image.
            height: Height of the image.
        """
        return PixelRectangle(
            max(0, self.left - REACH_PX),
            max(0, self.top - REACH_PX),
            min(width, self.right + REACH_PX),
            min(height, self.bottom + REACH_PX),
        )

    def within(self, other: PixelRectangle) -> tuple[int, int, int, int]:
        """Its left, top, right and bottom relative to another rectangle."""
        return (
            self.left - other.left,
            self.top - other.top,
            self.right - other.left,
            self.bottom - other.top,
        )


def windows_of(width: int, height: int, window_pixels: int) -> list[PixelRectangle]:
    """The windows of an image, row by row: the fewest possible of nearly equal, nearly square cells.

    Args:
        width: Width of the image, pixels.
        height: Height of the image, pixels.
        window_pixels: Most pixels of a window; 0 for one window over the whole image. Sides never fall below
            ``MIN_SIDE_PX``.
    """
    if window_pixels == 0 or width * height <= window_pixels:
        return [PixelRectangle(0, 0, width, height)]
    rows, columns = _divisions(width, height, window_pixels)
    across, down = _borders(width, columns), _borders(height, rows)
    return [
        PixelRectangle(left, top, right, bottom) for top, bottom in pairwise(down) for left, right in pairwise(across)
    ]


def _divisions(width: int, height: int, window_pixels: int) -> tuple[int, int]:
    """Number of rows and columns of cells: the fewest cells that fit, and of those the most nearly square."""
    most_rows, most_columns = max(1, height // MIN_SIDE_PX), max(1, width // MIN_SIDE_PX)
    found: list[tuple[int, bool, int, float, int, int]] = []
    for rows in range(1, most_rows + 1):
        tallest = _longest(height, rows)
        columns = min(most_columns, max(1, width * tallest // window_pixels))
        while columns < most_columns and tallest * _longest(width, columns) > window_pixels:
            columns += 1
        excess = max(0, tallest * _longest(width, columns) - window_pixels)
        aspect = (width / columns) / (height / rows)
        oblong = max(aspect, 1.0 / aspect)
        found.append((excess, oblong > MAX_OBLONG, rows * columns, oblong, rows, columns))
    *_, rows, columns = min(found)
    return rows, columns


def _longest(size: int, parts: int) -> int:
    return max(after - before for before, after in pairwise(_borders(size, parts)))


def _borders(size: int, parts: int) -> list[int]:
    """The cells' borders along a side, from 0 to its size."""
    inner = [NODES_PX * round((size * part / parts - REACH_PX) / NODES_PX) + REACH_PX for part in range(1, parts)]
    return [0, *inner, size]
