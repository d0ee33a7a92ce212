"""What an iteration looks at of its photo: how often it is halved, and which window of that counts.

Windows are the cells of a grid over the photo. Their borders lie where a window that is grown by the reach of SSIM
begins on a node of the sky's grid, so that what is interpolated between nodes is the same in a window and in the whole.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

REACH_PX = 5  # of SSIM: half its window, which looks so far over a border
NODES_PX = 8  # apart: the panorama's `STEP_PX`
LEAST_SIDE_PX = 2 * NODES_PX  # of a cell: borders are moved by half the nodes' distance at most
MOST_OBLONG = 2.5  # sides of a cell: strips cost more at their borders than a few cells more


@dataclass(frozen=True)
class TrainingSize:
    """A size to train at.

    Attributes:
        level: How often the photo is halved.
        window_pixels: Of the halved photo, that count in an iteration at most; 0 for all of it, however large.
    """

    level: int = 0
    window_pixels: int = 0


@dataclass(frozen=True)
class PixelRectangle:
    """A rectangle of a picture, pixels.

    Attributes:
        left: Its first column.
        top: Its first row.
        right: The column after its last.
        bottom: The row after its last.
    """

    left: int
    top: int
    right: int
    bottom: int

    @property
    def width(self) -> int:
        """Its columns."""
        return self.right - self.left

    @property
    def height(self) -> int:
        """Its rows."""
        return self.bottom - self.top

    @property
    def pixels(self) -> int:
        """How many it has."""
        return self.width * self.height

    def grown(self, width: int, height: int) -> PixelRectangle:
        """With all that SSIM sees from inside, as far as the picture goes.

        Args:
            width: Of the picture.
            height: Of the picture.
        """
        return PixelRectangle(
            max(0, self.left - REACH_PX),
            max(0, self.top - REACH_PX),
            min(width, self.right + REACH_PX),
            min(height, self.bottom + REACH_PX),
        )

    def within(self, other: PixelRectangle) -> tuple[int, int, int, int]:
        """Its left, top, right and bottom in the pixels of another frame."""
        return (
            self.left - other.left,
            self.top - other.top,
            self.right - other.left,
            self.bottom - other.top,
        )


def windows_of(width: int, height: int, window_pixels: int) -> list[PixelRectangle]:
    """The windows of a picture, row by row: as few as there can be of nearly equal, nearly square cells.

    Args:
        width: Of the picture, pixels.
        height: Of the picture, pixels.
        window_pixels: Of a window at most; 0 for the whole picture in one. Cells are never under ``LEAST_SIDE_PX``.
    """
    if window_pixels == 0 or width * height <= window_pixels:
        return [PixelRectangle(0, 0, width, height)]
    rows, columns = _divisions(width, height, window_pixels)
    across, down = _borders(width, columns), _borders(height, rows)
    return [
        PixelRectangle(left, top, right, bottom) for top, bottom in pairwise(down) for left, right in pairwise(across)
    ]


def _divisions(width: int, height: int, window_pixels: int) -> tuple[int, int]:
    """How many rows and columns of cells: as few cells as fit, of those the most nearly square."""
    most_rows, most_columns = max(1, height // LEAST_SIDE_PX), max(1, width // LEAST_SIDE_PX)
    found: list[tuple[int, bool, int, float, int, int]] = []
    for rows in range(1, most_rows + 1):
        tallest = _longest(height, rows)
        columns = min(most_columns, max(1, width * tallest // window_pixels))
        while columns < most_columns and tallest * _longest(width, columns) > window_pixels:
            columns += 1
        excess = max(0, tallest * _longest(width, columns) - window_pixels)
        aspect = (width / columns) / (height / rows)
        oblong = max(aspect, 1.0 / aspect)
        found.append((excess, oblong > MOST_OBLONG, rows * columns, oblong, rows, columns))
    *_, rows, columns = min(found)
    return rows, columns


def _longest(size: int, parts: int) -> int:
    return max(after - before for before, after in pairwise(_borders(size, parts)))


def _borders(size: int, parts: int) -> list[int]:
    """Where the cells along a side end, from 0 to its size."""
    inner = [NODES_PX * round((size * part / parts - REACH_PX) / NODES_PX) + REACH_PX for part in range(1, parts)]
    return [0, *inner, size]
