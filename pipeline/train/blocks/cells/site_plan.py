"""The output of the stage `blocks` for training and merging: the number of blocks and the limits of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.engine.files.json_file import json_text, read_json
from splatpipe.pipeline.train.blocks.cells.division import Division
from splatpipe.pipeline.train.blocks.cells.needs import (
    FROZEN_SHARE,
    MARGIN_GROWTH,
    frozen_bytes,
    shared_cap,
    with_margin,
)
from splatpipe.pipeline.train.blocks.cells.partition import Partition
from splatpipe.pipeline.train.plan.limits import FIXED_BYTES, LIBRARIES_BYTES, PIXEL_BYTES, bytes_per_gaussian

# growth of a cell with its margin over the cell: beyond it, the neighbours are what is full
MAX_GROWTH = 2.0 * MARGIN_GROWTH


@dataclass(frozen=True)
class BlockLimits:
    """The limits of a block.

    Attributes:
        share: Maximum number of Gaussians of the merged scene in its cell.
        trained: Maximum number of trained Gaussians, in cell and margin.
        frozen: Maximum number of frozen Gaussians rendered around it.
    """

    share: int
    trained: int
    frozen: int


@dataclass(frozen=True)
class SitePlan:
    """How a scene is trained in blocks.

    Attributes:
        partition: The cells.
        blocks: The limits of each block, in order of the cells.
        window_pixels: Most pixels of a photo that an iteration uses.
        limit_bytes: Memory limit; 0 for none.
    """

    partition: Partition
    blocks: tuple[BlockLimits, ...]
    window_pixels: int
    limit_bytes: int

    def to_json(self) -> str:
        """The text of `blocks.json`."""
        fields = {
            "shards": len(self.blocks),
            "limit_bytes": self.limit_bytes,
            "window_pixels": self.window_pixels,
            "partition": self.partition.facts(),
            "blocks": [asdict(block) for block in self.blocks],
        }
        return json_text(fields)


def whole_json(limit_bytes: int = 0) -> str:
    """The text of `blocks.json` for a scene that is trained whole.

    Args:
        limit_bytes: Memory limit that was not requested but that the training has to enforce; 0 for none.
    """
    return json_text({"shards": 0} | ({"limit_bytes": limit_bytes} if limit_bytes else {}))


def is_in_blocks(path: Path) -> bool:
    """Whether the scene is trained in blocks.

    Raises:
        StageError: if it cannot be read.
    """
    try:
        return int(read_json(path)["shards"]) > 0
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise StageError(f"{path.name} cannot be read.", hint="Run again with --rerun-from blocks.") from error


def limit_of_whole(path: Path) -> int:
    """The memory limit that the training of a whole scene has to enforce although it was not requested; 0 for none.

    Raises:
        StageError: if it cannot be read, or belongs to a scene in blocks.
    """
    try:
        fields: Any = read_json(path)
        if int(fields["shards"]):
            raise StageError(
                f"None of the {fields['shards']} blocks is available for merging.",
                hint="Run again: missing blocks are trained.",
            )
        return int(fields.get("limit_bytes", 0))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise StageError(f"{path.name} cannot be read.", hint="Run again with --rerun-from blocks.") from error


def load_site_plan(path: Path) -> SitePlan:
    """Read the output of `blocks` for a scene that is trained in blocks.

    Raises:
        StageError: if it is not such a file.
    """
    try:
        fields: Any = read_json(path)
        partition = Partition.of_facts(fields["partition"])
        blocks = tuple(BlockLimits(**block) for block in fields["blocks"])
        if len(blocks) != len(partition.cells):
            raise ValueError("another number of cells")
        return SitePlan(partition, blocks, int(fields["window_pixels"]), int(fields["limit_bytes"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise StageError(f"{path.name} cannot be read.", hint="Run again with --rerun-from blocks.") from error


def block_limits(
    division: Division, sh_degree: int, block_counts: Sequence[tuple[float, int, int]]
) -> list[BlockLimits]:
    """Share the cap among blocks, so that each keeps within the memory limit.

    Args:
        division: How the scene is divided.
        sh_degree: SH degree of the model.
        block_counts: For each block its weight, and the number of the coarse model's Gaussians in its cell and in cell
            and margin.
    """
    cap, most = division.cap, _most(division, sh_degree)
    top = max(1, int(most / MARGIN_GROWTH)) if division.limit_bytes else cap
    found = []
    shares = capped_shares(cap, [weight for weight, _, _ in block_counts], [top] * len(block_counts))
    for share, (_, in_cell, in_block) in zip(shares, block_counts, strict=True):
        wanted = max(share, min(with_margin(share, in_cell, in_block), int(MAX_GROWTH * share)))
        trained = max(share, min(wanted, most)) if division.limit_bytes else wanted
        found.append(BlockLimits(share, trained, _frozen(division, trained, sh_degree)))
    return found


def _most(division: Division, sh_degree: int) -> int:
    """Number of Gaussians that a block may train within the memory limit, with as many frozen ones around."""
    room = division.limit_bytes - LIBRARIES_BYTES - FIXED_BYTES - PIXEL_BYTES * division.window_pixels
    fitting = int(room / (bytes_per_gaussian(sh_degree) + FROZEN_SHARE * frozen_bytes(sh_degree)))
    return max(division.need.trained, fitting)


def _frozen(division: Division, trained: int, sh_degree: int) -> int:
    """Number of frozen Gaussians around a block that fit in memory; without a limit, the whole coarse model."""
    if not division.limit_bytes:
        return max(1, division.coarse_cap)
    room = division.limit_bytes - LIBRARIES_BYTES - FIXED_BYTES - PIXEL_BYTES * division.window_pixels
    left = room - trained * bytes_per_gaussian(sh_degree)
    return max(1, min(division.coarse_cap, left // frozen_bytes(sh_degree)))


def capped_shares(cap: int, weights: Sequence[float], tops: Sequence[int]) -> list[int]:
    """Share a cap by weight among blocks with individual maximums; what one cannot take goes to the others.

    Args:
        cap: Total number of Gaussians.
        weights: Non-negative weight of each block; equal shares if all are 0.
        tops: Maximum of each block.

    Returns:
        The shares; they add up to less than the cap only if all are at their maximum.
    """
    shares = [0] * len(weights)
    open_ones, rest = list(range(len(weights))), cap
    while open_ones:
        parts = shared_cap(rest, [weights[k] for k in open_ones])
        full = [k for k, part in zip(open_ones, parts, strict=True) if part >= tops[k]]
        for k, part in zip(open_ones, parts, strict=True):
            shares[k] = min(part, tops[k])
        if not full:
            break
        rest -= sum(tops[k] for k in full)
        open_ones = [k for k in open_ones if k not in full]
    return shares
