"""Into how many blocks a scene is cut: as few as keep to a limit of memory. Plain arithmetic, light to import.

A scene whose cap on Gaussians fits, or that is not thought to come near to what fits, is one whole. Else the cap stays
and the scene is cut, into blocks of some photos each at least; only where that is not enough is the cap lowered.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from splatpipe.pipeline.train.blocks.needs import (
    FROZEN_SHARE,
    MARGIN_GROWTH,
    BlockNeed,
    fewest_blocks,
    frozen_bytes,
    need_of_blocks,
)
from splatpipe.pipeline.train.limits import (
    FIXED_BYTES,
    LIBRARIES_BYTES,
    MACHINE_SHARE,
    PIXEL_BYTES,
    bytes_per_gaussian,
    window_within,
)

PHOTOS_A_BLOCK = 8  # at least: of smaller blocks each photo shows many, and each looks at it again
FEWEST_GAUSSIANS = 1000  # of a block: fewer are no model
LIKELY_MOST = 2.0  # times what a scene is thought to grow to, it hardly ever does: forecasts are off by so much


@dataclass(frozen=True)
class SceneSize:
    """What says how much memory a training takes.

    Attributes:
        cap: On Gaussians.
        expected: Gaussians that its photos are thought to ask for.
        window_pixels: That an iteration looks at, at most, where memory is no matter.
        sh_degree: SH degree of the model.
        photos: That are trained on.
    """

    cap: int
    expected: float
    window_pixels: int
    sh_degree: int
    photos: int


@dataclass(frozen=True)
class Division:
    """How a scene is trained.

    Attributes:
        blocks: How many; 1 is the whole in one.
        cap: On Gaussians of the whole; lower than asked for only where no more blocks make sense.
        limit_bytes: Of memory; 0 for none.
        window_pixels: That an iteration looks at, at most.
        need: What one of the blocks takes, without the libraries.
        coarse_cap: On Gaussians of the pass over the whole that comes before blocks: of those of the whole as many as
            the limit holds, for what it lacks no block makes up for.
        is_near: Whether a whole one may come near the limit: of too few photos for blocks, its training keeps to it.
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
        """Whether there are no blocks."""
        return self.blocks == 1

    @property
    def memory_bytes(self) -> int:
        """Of the process that trains one of the blocks."""
        return LIBRARIES_BYTES + self.need.memory_bytes

    @staticmethod
    def of_facts(facts: Any) -> Division:
        """The inverse of ``dataclasses.asdict``, from JSON.

        Raises:
            KeyError, TypeError: if it is something else.
        """
        return Division(**{**facts, "need": BlockNeed(**facts["need"])})


def memory_limit(asked_bytes: int, machine_bytes: int) -> int:
    """The limit that a training keeps to: the one that was asked for, or most of the machine's; 0 for none.

    Args:
        asked_bytes: ``train.max_memory_bytes``; 0 for none.
        machine_bytes: That the machine has; 0 where nobody says.
    """
    return asked_bytes or int(MACHINE_SHARE * machine_bytes)


def divided(scene: SceneSize, limit_bytes: int, least: int = 0) -> Division:
    """How many blocks there are, and what each takes.

    Args:
        scene: What is trained.
        limit_bytes: Of the process that trains; 0 for none.
        least: Blocks that somebody wants at least; 0 for as few as there can be.
    """
    if not limit_bytes:
        return _of(scene, max(1, least), scene.cap, limit_bytes, scene.window_pixels)
    room = limit_bytes - LIBRARIES_BYTES
    window = window_within(room - FIXED_BYTES, scene.window_pixels)
    likely = min(scene.cap, int(LIKELY_MOST * scene.expected))
    if need_of_blocks(1, likely, window, scene.sh_degree).memory_bytes <= room:
        return _of(scene, max(1, least), scene.cap, limit_bytes, window)
    most = max(1, least, scene.photos // PHOTOS_A_BLOCK)
    wanted = fewest_blocks(scene.cap, room, window, scene.sh_degree) or most + 1
    blocks, cap = max(wanted, least), scene.cap
    if blocks > most:
        blocks, cap = most, _most_gaussians(most, room, window, scene.sh_degree)
        if cap < FEWEST_GAUSSIANS * blocks:  # the training of the whole says what is too little
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
    """Most Gaussians of a scene in so many blocks, each of which keeps to a limit."""
    of_one = bytes_per_gaussian(sh_degree) + (FROZEN_SHARE * frozen_bytes(sh_degree) if blocks > 1 else 0.0)
    fitting = max(0, int((room - FIXED_BYTES - PIXEL_BYTES * window) / of_one))
    return fitting if blocks == 1 else int(fitting / MARGIN_GROWTH) * blocks
