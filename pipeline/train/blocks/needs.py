"""How many blocks a memory limit asks for, and what one of them takes: plain arithmetic, light to import.

A block holds, besides what every training holds, the Gaussians of its cell and margin with all that their training
needs, and the frozen ones around it, which need their parameters and room for what a frame says of them. The number of
photos is in none of it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from splatpipe.pipeline.train.limits import (
    FIXED_BYTES,
    FLOAT_BYTES,
    PIXEL_BYTES,
    bytes_per_gaussian,
    numbers_of,
)

MARGIN_GROWTH = 1.44  # (1 + 2 × 0.1)²: a square cell with its margin, over the cell
FROZEN_SHARE = 1.0  # of those that a block trains: what it sees of a coarse model that is larger is thinned
FROZEN_COPIES = 2  # of a frozen Gaussian's parameters: density control copies them with the others
FRAME_BYTES = 201  # of any Gaussian in a frame (`limits.py`)
SPLAT_BYTES = 249  # of a Gaussian in a file
CHECKPOINT_BYTES = 2 * 720  # of a Gaussian that is trained: parameters and moments, and the new one beside the old
GROWTH_A_STEP = 1.25  # of what a block trains, in a step of density control: 1.2 in the tiled demo, 1.8 at first where
# a coarse pass ended at smaller photos
MOST_BLOCKS = 4096  # beyond it a block is no larger than its margin


@dataclass(frozen=True)
class BlockNeed:
    """What a block takes.

    Attributes:
        trained: Gaussians of its cell and margin, at most.
        frozen: Gaussians around it, at most.
        memory_bytes: While it trains.
    """

    trained: int
    frozen: int
    memory_bytes: int


def frozen_bytes(sh_degree: int) -> int:
    """Most that a frozen Gaussian takes."""
    return FROZEN_COPIES * FLOAT_BYTES * numbers_of(sh_degree) + FRAME_BYTES


def grown_from(start: int, steps: int, most: int) -> int:
    """Gaussians that a block is expected to train at its end.

    Args:
        start: The coarse model's in its cell and margin.
        steps: Of density control.
        most: That it may train.
    """
    return int(min(most, start * GROWTH_A_STEP**steps))


def block_need(trained: int, frozen: int, window_pixels: int, sh_degree: int) -> BlockNeed:
    """What a block of that size takes on the CPU.

    Args:
        trained: Gaussians that it trains, at most.
        frozen: Gaussians that it draws besides, at most.
        window_pixels: Of the largest window.
        sh_degree: SH degree of the model.
    """
    of_gaussians = trained * bytes_per_gaussian(sh_degree) + frozen * frozen_bytes(sh_degree)
    return BlockNeed(trained, frozen, FIXED_BYTES + PIXEL_BYTES * window_pixels + of_gaussians)


def need_of_blocks(blocks: int, cap: int, window_pixels: int, sh_degree: int) -> BlockNeed:
    """What each of so many equal blocks takes; one block is the whole, without margin and surroundings.

    Args:
        blocks: At least 1.
        cap: Gaussians of the whole scene.
        window_pixels: Of the largest window.
        sh_degree: SH degree of the model.
    """
    if blocks == 1:
        return block_need(cap, 0, window_pixels, sh_degree)
    trained = min(cap, int(-(-cap // blocks) * MARGIN_GROWTH))
    return block_need(trained, int(FROZEN_SHARE * trained), window_pixels, sh_degree)


def fewest_blocks(cap: int, room_bytes: int, window_pixels: int, sh_degree: int) -> int | None:
    """The fewest equal blocks of a scene, each of which keeps to a limit; None where no number of them does.

    Args:
        cap: Gaussians of the whole scene.
        room_bytes: Of the limit, what the process has not taken already.
        window_pixels: Of the largest window.
        sh_degree: SH degree of the model.
    """
    for blocks in range(1, MOST_BLOCKS + 1):
        if need_of_blocks(blocks, cap, window_pixels, sh_degree).memory_bytes <= room_bytes:
            return blocks
    return None


def work_bytes(trained: int, frozen: int) -> int:
    """What a block has on the disk while it trains, besides its photos: its checkpoints, and what is around it.

    Args:
        trained: Gaussians that it trains.
        frozen: Gaussians that it draws besides.
    """
    return CHECKPOINT_BYTES * trained + SPLAT_BYTES * frozen


def round_pixels(pixels: float, blocks: int, window_side: float, site_area: float) -> float:
    """Pixels of one visit of each window that one of so many equal blocks trains on.

    A window that shows a square of the ground meets, along each axis, one cell and as many more as borders cross it, on
    average over where on the site it lies: so often is it trained on. Oblique windows show more than a square.

    Args:
        pixels: Of all photos, at the size that is trained.
        blocks: At least 1.
        window_side: Of what a window shows of the ground, world units: its pixels' root times the size of one.
        site_area: Of all cells, square world units.
    """
    meets = 1.0 + (math.sqrt(blocks) - 1.0) * window_side / math.sqrt(site_area)
    return pixels * min(1.0, meets**2 / blocks)


def shared_cap(cap: int, weights: Sequence[float], least: int = 0) -> list[int]:
    """A cap on Gaussians shared among blocks; the shares add up to it.

    By the largest remainders (Hamilton's method), the first of equal ones before the others.

    Args:
        cap: Of all together.
        weights: Of each block, not negative; equal shares where all are 0.
        least: What each gets before the rest is shared by weight.

    Raises:
        ValueError: if there is no block, a weight is negative, or the cap does not hold the least of each.
    """
    if not weights or min(weights) < 0.0 or cap < least * len(weights):
        raise ValueError(f"{cap} Gaussians cannot be shared among {len(weights)} blocks")
    total = float(sum(weights))
    parts = [weight / total if total > 0.0 else 1.0 / len(weights) for weight in weights]
    rest = cap - least * len(weights)
    shares = [int(rest * part) for part in parts]
    order = sorted(range(len(parts)), key=lambda k: (shares[k] - rest * parts[k], k))
    for k in order[: rest - sum(shares)]:
        shares[k] += 1
    return [least + share for share in shares]


def with_margin(own: int, in_cell: int, in_block: int) -> int:
    """How many Gaussians a block may train, so that those of its cell can be as many as its share.

    Args:
        own: Its share of the cap.
        in_cell: The coarse model's Gaussians in its cell.
        in_block: Those in cell and margin.
    """
    return own if in_cell == 0 else max(own, -(-own * in_block // in_cell))
