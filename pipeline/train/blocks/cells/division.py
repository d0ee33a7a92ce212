"""The number of blocks of a scene: as few as the memory limit allows. Plain arithmetic, cheap to import.

A scene whose cap on Gaussians fits, or that is not expected to come near the limit, is trained whole. Otherwise the cap
stays and the scene is cut into blocks of at least a few photos each; only if that is not enough is the cap lowered.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from splatpipe.pipeline.train.blocks.cells.needs import (
    FROZEN_SHARE,
    MARGIN_GROWTH,
    BlockNeed,
    fewest_blocks,
    frozen_bytes,
    need_of_blocks,
)
from splatpipe.pipeline.train.plan.limits import (
    FIXED_BYTES,
    LIBRARIES_BYTES,
    MACHINE_SHARE,
    PIXEL_BYTES,
    bytes_per_gaussian,
    window_within,
)

PHOTOS_A_BLOCK = 8  # at least: each photo shows many smaller blocks and would be trained on in each
MIN_BLOCK_GAUSSIANS = 1000  # Gaussians of a block: fewer are not a useful model
MAX_LIKELY_GROWTH = 2.0  # times the expected size is hardly ever exceeded: forecasts are off by up to this factor


@dataclass(frozen=True)
class SceneSize:
    """The quantities that determine the memory of a training.

    Attributes:
        cap: Maximum number of Gaussians.
        expected: Number of Gaussians that the photos are expected to need.
        window_pixels: Most pixels that an iteration uses if memory does not matter.
        sh_degree: SH degree of the model.
        photos: Number of training photos.
    """

    cap: int
    expected: float
    window_pixels: int
    sh_degree: int
    photos: int


@dataclass(frozen=True)
class Division:
    """How a scene is divided for training.

    Attributes:
        blocks: Number of blocks; 1 means the whole scene at once.
        cap: Maximum number of Gaussians in the scene; lower than requested only if more blocks make no sense.
        limit_bytes: Memory limit; 0 for none.
        window_pixels: Most pixels that an iteration uses.
        need: What each block takes, without the libraries.
        coarse_cap: Maximum number of Gaussians in the coarse pass: as many of the scene's as the limit allows, because
            blocks cannot make up for what it lacks.
        is_near: Whether a whole scene may come near the limit: with too few photos for blocks, its training has to
            enforce the limit.
    """

    blocks: int
    cap: int
    limit_bytes: int
    window_pixels: int
    need: BlockNeed
    coarse_cap: int
    is_near: bool = False

    @property
    def is_whole(self) -> bool:
        """Whether the scene is trained whole, without blocks."""
        return self.blocks == 1

    @property
    def memory_bytes(self) -> int:
        """Memory of the process that trains one of the blocks."""
        return LIBRARIES_BYTES + self.need.memory_bytes

    @staticmethod
    def of_facts(facts: Any) -> Division:
        """The inverse of ``dataclasses.asdict``, from JSON.

        Raises:
            KeyError, TypeError: if it is not a division.
        """
        return Division(**{**facts, "need": BlockNeed(**facts["need"])})


def memory_limit(asked_bytes: int, machine_bytes: int) -> int:
    """The memory limit of a training: the requested one, or most of the machine's memory; 0 for none.

    Args:
        asked_bytes: ``train.max_memory_bytes``; 0 for none.
        machine_bytes: The machine's memory; 0 if unknown.
    """
    return asked_bytes or int(MACHINE_SHARE * machine_bytes)


def divided(scene: SceneSize, limit_bytes: int, least: int = 0) -> Division:
    """The number of blocks, and what each takes.

    Args:
        scene: The scene to train.
        limit_bytes: Memory limit of the training process; 0 for none.
        least: Requested minimum number of blocks; 0 for as few as possible.
    """
    if not limit_bytes:
        return _of(scene, max(1, least), scene.cap, limit_bytes, scene.window_pixels)
    room = limit_bytes - LIBRARIES_BYTES
    window = window_within(room - FIXED_BYTES, scene.window_pixels)
    likely = min(scene.cap, int(MAX_LIKELY_GROWTH * scene.expected))
    if need_of_blocks(1, likely, window, scene.sh_degree).memory_bytes <= room:
        return _of(scene, max(1, least), scene.cap, limit_bytes, window)
    most = max(1, least, scene.photos // PHOTOS_A_BLOCK)
    wanted = fewest_blocks(scene.cap, room, window, scene.sh_degree) or most + 1
    blocks, cap = max(wanted, least), scene.cap
    if blocks > most:
        blocks, cap = most, _most_gaussians(most, room, window, scene.sh_degree)
        if cap < MIN_BLOCK_GAUSSIANS * blocks:  # the whole training reports that memory is too small
            blocks, cap = 1, _most_gaussians(1, room, window, scene.sh_degree)
    return replace(_of(scene, blocks, min(cap, scene.cap), limit_bytes, window), is_near=blocks == 1)


def _of(scene: SceneSize, blocks: int, cap: int, limit_bytes: int, window: int) -> Division:
    fitting = cap
    if limit_bytes:
        fitting = _most_gaussians(1, limit_bytes - LIBRARIES_BYTES, window, scene.sh_degree)
    cap = min(cap, fitting) if blocks == 1 else cap
    need = need_of_blocks(blocks, cap, window, scene.sh_degree)
    return Division(blocks, cap, limit_bytes, window, need, min(cap, fitting))


def _most_gaussians(blocks: int, room: int, window: int, sh_degree: int) -> int:
    """Maximum number of Gaussians of a scene in a number of blocks, each within the limit."""
    of_one = bytes_per_gaussian(sh_degree) + (FROZEN_SHARE * frozen_bytes(sh_degree) if blocks > 1 else 0.0)
    fitting = max(0, int((room - FIXED_BYTES - PIXEL_BYTES * window) / of_one))
    return fitting if blocks == 1 else int(fitting / MARGIN_GROWTH) * blocks
