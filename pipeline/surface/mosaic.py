"""Which photo colours which cell: the best one, with seams where the photos look alike."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64, UInt8

NEVER = np.int32(1 << 28)  # cost of a photo that does not see a cell
HIDDEN = 4000  # what such a cell adds to the cost around it: photos end before they end; and no cost is higher
SMOOTH = 10  # cells on either side that a cell's costs are averaged over
SOFT = 2  # cells on either side over which photos are softened before they are compared
ODD_FREE = 15  # grey values that a photo may differ from the others without being odd...
ODD = 15  # ...and what each more costs
ODD_MOST = 60  # more differ by no more
SEAM = 60  # cost of a seam between two cells,
SEAM_STEP = 12  # and of each grey value that the photos differ there
SWEEPS = 6  # in which seams move to better places
FEATHER = 2  # cells on either side of a seam over which photos blend
MARGIN = SMOOTH + SOFT + 2 * SWEEPS + FEATHER + 1  # cells around a tile that its colours depend on


def likeness_cost(
    grey: UInt8[np.ndarray, "n h w"], cost: Int32[np.ndarray, "n h w"], seen: Bool[np.ndarray, "n h w"]
) -> Int32[np.ndarray, "n h w"]:
    """What is added to photos that show something else than most: cars that drove on, what depths did not know.

    The others' grey is a mean in which better photos count more, taken again without those that are far from it; all
    softened, for a texture that two photos show a fraction of a pixel apart is not odd.
    """
    soft = np.stack([_softened(*pair) for pair in zip(grey, seen, strict=True)])
    weight = np.where(seen, np.int32(1 << 16) // (cost + 64), np.int32(0))  # 1024 at most: sums of 255 × it fit
    mean = np.zeros(grey.shape[1:], np.int32)
    for _ in range(2):
        total = np.maximum(weight.sum(axis=0, dtype=np.int32), 1)
        mean = (weight * soft).sum(axis=0, dtype=np.int32) // total
        off = np.abs(soft - mean)
        weight = weight // np.maximum(1, off // ODD_FREE) ** 2
    return np.where(seen, ODD * np.clip(off - ODD_FREE, 0, ODD_MOST), 0).astype(np.int32)


def _softened(grey: UInt8[np.ndarray, "h w"], seen: Bool[np.ndarray, "h w"]) -> Int32[np.ndarray, "h w"]:
    """The mean around each cell of those that the photo sees."""
    total, count = (_box(part, SOFT) for part in (np.where(seen, grey, 0).astype(np.int32), seen.astype(np.int32)))
    return np.asarray(total // np.maximum(count, 1))


def labels(
    cost: Int32[np.ndarray, "n h w"], seen: Bool[np.ndarray, "n h w"], grey: UInt8[np.ndarray, "n h w"], parity: int
) -> Int64[np.ndarray, "h w"]:
    """The photo of each cell, -1 where none sees it: whole numbers throughout, so that tiles agree at their borders.

    First the least cost averaged around each cell (Hosni et al., "Fast Cost-Volume Filtering", 2013), then seams move,
    one colour of a chessboard after the other, to where both photos look alike, by the seam's cost of Kwatra et al.
    ("Graphcut Textures", 2003).

    Args:
        cost: Of each photo in each cell, also where it does not see it.
        seen: Whether it sees it.
        grey: Its values, levelled.
        parity: Of the first cell's row plus column in the whole picture.
    """
    smooth = np.empty_like(cost)
    side = 2 * SMOOTH + 1
    for number in range(len(cost)):
        total = _box(np.minimum(cost[number], np.int32(HIDDEN)), SMOOTH)
        smooth[number] = np.where(seen[number], total // (side * side), NEVER)
    label = np.argmin(smooth, axis=0)
    label = np.where(np.take_along_axis(smooth, label[None], 0)[0] >= NEVER, -1, label)
    for _ in range(SWEEPS):
        for colour in (0, 1):
            _move(label, smooth, grey, (parity + colour) % 2)
    return label


def _box(values: Int32[np.ndarray, "h w"], radius: int) -> Int32[np.ndarray, "h w"]:
    """Sums around each cell, exact; what is outside repeats the rim."""
    side = 2 * radius + 1
    total = cv2.boxFilter(values, cv2.CV_32S, (side, side), normalize=False, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(total, np.int32)


BESIDE = ((-1, 0), (1, 0), (0, -1), (0, 1))


def _move(
    label: Int64[np.ndarray, "h w"], cost: Int32[np.ndarray, "n h w"], grey: UInt8[np.ndarray, "n h w"], colour: int
) -> None:
    """Give cells at seams, of one colour of the board, the label of a neighbour where that is cheaper."""
    inner = label[1:-1, 1:-1]
    at_seam = np.zeros(inner.shape, np.bool_)
    for down, right in BESIDE:
        at_seam |= inner != label[1 + down : label.shape[0] - 1 + down, 1 + right : label.shape[1] - 1 + right]
    rows, columns = np.nonzero(at_seam & (inner >= 0))
    rows, columns = rows + 1, columns + 1
    kept = (rows + columns) % 2 == colour
    rows, columns = rows[kept], columns[kept]
    around = [(rows + down, columns + right) for down, right in BESIDE]
    theirs = [label[place] for place in around]
    best = label[rows, columns]
    least = _energy(best, rows, columns, (around, theirs), (cost, grey))
    for candidate in theirs:
        usable = candidate >= 0
        energy = _energy(np.where(usable, candidate, 0), rows, columns, (around, theirs), (cost, grey))
        better = usable & ((energy < least) | ((energy == least) & (candidate < best)))
        best, least = np.where(better, candidate, best), np.where(better, energy, least)
    label[rows, columns] = best


def _energy(
    mine: Int64[np.ndarray, " k"],
    rows: Int64[np.ndarray, " k"],
    columns: Int64[np.ndarray, " k"],
    neighbours: tuple[list[tuple[np.ndarray, np.ndarray]], list[np.ndarray]],
    pictures: tuple[np.ndarray, np.ndarray],
) -> Int64[np.ndarray, " k"]:
    cost, grey = pictures
    total = cost[mine, rows, columns].astype(np.int64)
    for place, other in zip(*neighbours, strict=True):
        known = np.maximum(other, 0)
        here = np.abs(grey[mine, rows, columns].astype(np.int64) - grey[known, rows, columns])
        there = np.abs(grey[mine, *place].astype(np.int64) - grey[known, *place])
        total += np.where((other >= 0) & (other != mine), SEAM + SEAM_STEP * (here + there), 0)
    return np.asarray(total)


def blended(
    label: Int64[np.ndarray, "h w"], colour: UInt8[np.ndarray, "n h w 3"], seen: Bool[np.ndarray, "n h w"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Colours of the cells' photos, mixed over a few cells at seams, of photos that see the cell; black where none."""
    total = np.zeros((*label.shape, 3), np.int32)
    weights = np.zeros(label.shape, np.int32)
    for number in np.unique(label[label >= 0]):
        weight = np.where(seen[number], _box((label == number).astype(np.int32), FEATHER), 0).astype(np.int32)
        total += weight[..., None] * colour[number]
        weights += weight
    return ((total + weights[..., None] // 2) // np.maximum(weights, 1)[..., None]).astype(np.uint8)


def spread(
    colour: UInt8[np.ndarray, "h w 3"], known: Bool[np.ndarray, "h w"], wanted: Bool[np.ndarray, "h w"], cells: int
) -> tuple[UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """Fill wanted cells from known ones around, cell by cell outwards, so many cells far.

    Returns:
        The colours, and which cells have one now.
    """
    colour, known = colour.copy(), known.copy()
    for _ in range(cells):
        count = np.asarray(
            cv2.boxFilter(known.astype(np.uint8), cv2.CV_32S, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
        )
        new = wanted & ~known & (count > 0)
        if not new.any():
            break
        rows, columns = np.nonzero(new)
        total = np.zeros((len(rows), 3), np.int64)
        wide, there = np.pad(colour, ((1, 1), (1, 1), (0, 0))), np.pad(known, 1)
        for down in (0, 1, 2):
            for right in (0, 1, 2):
                at = (rows + down, columns + right)
                total += np.where(there[at][:, None], wide[at], 0)
        number = count[rows, columns][:, None]
        colour[rows, columns] = (total + number // 2) // number
        known |= new
    return colour, known


def parity_of(row: int, column: int) -> int:
    """Colour of a cell on the whole picture's chessboard, as ``labels`` wants it."""
    return (row + column) % 2


def scaled_cost(value: Float64[np.ndarray, " *n"]) -> Int32[np.ndarray, " *n"]:
    """Costs as whole numbers, a thousand for each."""
    return np.minimum(np.round(value * 1000.0), HIDDEN).astype(np.int32)
