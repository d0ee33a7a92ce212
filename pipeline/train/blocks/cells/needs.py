"""How many blocks a memory limit requires, and the memory of one block: plain arithmetic, cheap to import.

Besides the base of every training, a block holds the Gaussians of its cell and margin with their training state, and
the frozen ones around it with their parameters and per-frame data. The number of photos does not matter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from splatpipe.pipeline.train.plan.limits import (
    FIXED_BYTES,
    FLOAT_BYTES,
    FRAME_BYTES,
    PIXEL_BYTES,
    bytes_per_gaussian,
    numbers_of,
)

MARGIN_GROWTH = 1.44  # (1 + 2 × 0.1)²: a square cell with its margin, over the cell
FROZEN_SHARE = 1.0  # frozen per trained Gaussian: more of the coarse model than that is thinned
FROZEN_COPIES = 2  # copies of a frozen Gaussian's parameters: density control copies them with the others
SPLAT_BYTES = 249  # per Gaussian in a file
CHECKPOINT_BYTES = 2 * 720  # per trained Gaussian: parameters and moments, the new checkpoint beside the old
# Growth of a block's Gaussians per density-control step: 1.2 in the tiled demo, 1.8 initially if the coarse pass ended
# at smaller photos.
GROWTH_A_STEP = 1.25
MAX_BLOCKS = 4096  # beyond it a block is not larger than its margin


@dataclass(frozen=True)
class BlockNeed:
    """The resources of a block.

    Attributes:
        trained: Maximum number of Gaussians in its cell and margin.
        frozen: Maximum number of frozen Gaussians around it.
        memory_bytes: Memory during its training.
    """

    trained: int
    frozen: int
    memory_bytes: int


def frozen_bytes(sh_degree: int) -> int:
    """Peak memory per frozen Gaussian, bytes."""
    return FROZEN_COPIES * FLOAT_BYTES * numbers_of(sh_degree) + FRAME_BYTES


def grown_from(start: int, steps: int, most: int) -> int:
    """Expected number of trained Gaussians at a block's end.

    Args:
        start: Number of the coarse model's Gaussians in its cell and margin.
        steps: Number of density-control steps.
        most: Maximum number of trained Gaussians.
    """
    return int(min(most, start * GROWTH_A_STEP**steps))


def block_need(trained: int, frozen: int, window_pixels: int, sh_degree: int) -> BlockNeed:
    """The memory of a block of a given size on the CPU.

    Args:
        trained: Maximum number of trained Gaussians.
        frozen: Maximum number of frozen Gaussians.
        window_pixels: Pixels of the largest window.
        sh_degree: SH degree of the model.
    """
    of_gaussians = trained * bytes_per_gaussian(sh_degree) + frozen * frozen_bytes(sh_degree)
    return BlockNeed(trained, frozen, FIXED_BYTES + PIXEL_BYTES * window_pixels + of_gaussians)


def need_of_blocks(blocks: int, cap: int, window_pixels: int, sh_degree: int) -> BlockNeed:
    """The memory of each of a number of equal blocks; a single block is the whole, without margin and surroundings.

    Args:
        blocks: Number of blocks, at least 1.
        cap: Maximum number of Gaussians in the whole scene.
        window_pixels: Pixels of the largest window.
        sh_degree: SH degree of the model.
    """
    if blocks == 1:
        return block_need(cap, 0, window_pixels, sh_degree)
    trained = min(cap, int(-(-cap // blocks) * MARGIN_GROWTH))
    return block_need(trained, int(FROZEN_SHARE * trained), window_pixels, sh_degree)


def fewest_blocks(cap: int, room_bytes: int, window_pixels: int, sh_degree: int) -> int | None:
    """The fewest equal blocks that each fit the limit; None if no number of blocks does.

    Args:
        cap: Maximum number of Gaussians in the whole scene.
        room_bytes: Memory limit less what the process already uses.
        window_pixels: Pixels of the largest window.
        sh_degree: SH degree of the model.
    """
    for blocks in range(1, MAX_BLOCKS + 1):
        if need_of_blocks(blocks, cap, window_pixels, sh_degree).memory_bytes <= room_bytes:
            return blocks
    return None


def work_bytes(trained: int, frozen: int) -> int:
    """Disk space of a block during training, besides its photos: checkpoints and frozen Gaussians.

    Args:
        trained: Number of trained Gaussians.
        frozen: Number of frozen Gaussians.
    """
    return CHECKPOINT_BYTES * trained + SPLAT_BYTES * frozen


def round_pixels(pixels: float, blocks: int, window_side: float, site_area: float) -> float:
    """Pixels in one visit of each window that one of a number of equal blocks trains on.

    A window that shows a square of the ground meets, along each axis, one cell plus one for each border that crosses
    it, on average over its position on the site; it is trained on in each of these. Oblique windows show more.

    Args:
        pixels: Pixels of all photos, at the training size.
        blocks: Number of blocks, at least 1.
        window_side: Side of a window on the ground, world units: the square root of its pixels times the GSD.
        site_area: Area of all cells, square world units.
    """
    meets = 1.0 + (math.sqrt(blocks) - 1.0) * window_side / math.sqrt(site_area)
    return pixels * min(1.0, meets**2 / blocks)


def shared_cap(cap: int, weights: Sequence[float], least: int = 0) -> list[int]:
    """Share a cap on Gaussians among blocks; the shares add up to the cap.

    Uses the largest-remainder method (Hamilton); ties go to the first.

    Args:
        cap: Total number of Gaussians.
        weights: Non-negative weight of each block; equal shares if all are 0.
        least: What each block gets before the rest is shared by weight.

    Raises:
        ValueError: if there is no block, a weight is negative, or the cap is below the sum of the minimums.
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
    """Number of Gaussians that a block may train so that its cell can reach its share.

    Args:
        own: The block's share of the cap.
        in_cell: Number of the coarse model's Gaussians in its cell.
        in_block: Number of those in cell and margin.
    """
    return own if in_cell == 0 else max(own, -(-own * in_block // in_cell))
