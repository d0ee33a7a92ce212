"""How many pairs of a Gaussian and a tile the next frame has, from those before it: the host never waits for a count.

What a frame has more than was foreseen is rendered all the same, with the same bits, but slowly (see native/cuda).
"""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass

import torch
from torch import Tensor

from splatpipe.pipeline.raster.cuda_api import SplatFrameFacts

FIRST_PAIRS_A_GAUSSIAN = 8  # of a frame of which nothing is known; a trained Gaussian touches 3 to 10 tiles
FIRST_PAIRS_A_TILE = 64  # and a start of few, large ones fills the tiles
FIRST_PASSES = 8  # once, so that a wrong guess costs launches that find nothing, not one block's work on the rest
MARGIN = 1.25  # over the most that was seen: between two looks views differ, and the model grows
WINDOW = 512  # frames after which the most before them begins to be forgotten: more than most trainings have photos
PAIR_BYTES = 64  # of the frame and its backward pass
MEMORY_SHARE = 1 / 16  # of the device's for pairs: several chunks are binned twice, so one should do where it can
FEWEST_PAIRS, MOST_PAIRS = 1 << 22, 1 << 28  # at a time: a small device's, which fill all of it; and 17 GB of them
STEPS_AN_OCTAVE = 8  # capacities are rounded up to these, so that torch's allocator finds the last frame's memory again
MOST_TILES = 1 << 16  # of a chunk, as in frame.h


@dataclass(frozen=True)
class FrameSize:
    """What is known of a frame before it is rendered.

    Attributes:
        count: Gaussians.
        tiles: Of the picture.
    """

    count: int
    tiles: int


@dataclass(frozen=True)
class FrameAllocation:
    """What a frame gets.

    Attributes:
        capacity: Pairs that it holds at a time.
        passes: Chunks that are worked off by the whole device.
    """

    capacity: int
    passes: int


@dataclass(frozen=True)
class FrameFacts:
    """What a frame took.

    Attributes:
        size: As it was asked for.
        capacity: As it was given.
        pairs: In all.
        chunks: That they took at that capacity.
    """

    size: FrameSize
    capacity: int
    pairs: int
    chunks: int


class PendingFacts:
    """Facts on their way from the device.

    Args:
        memory: A frame's, which begins with them; a frame is enqueued on the current stream.
        size: Of the frame.
        capacity: Of the frame.
    """

    def __init__(self, memory: Tensor, size: FrameSize, capacity: int) -> None:
        self._size, self._capacity = size, capacity
        numbers = len(SplatFrameFacts._fields_)
        on_cuda = memory.device.type == "cuda"
        self._numbers = torch.empty(numbers, dtype=torch.int64, pin_memory=on_cuda)
        self._numbers.copy_(memory[: 8 * numbers].view(torch.int64), non_blocking=True)
        self._event = torch.cuda.Event() if on_cuda else None  # type: ignore[no-untyped-call]
        if self._event is not None:
            self._event.record()

    def arrived(self) -> bool:
        """Whether the facts can be had without waiting."""
        return self._event is None or bool(self._event.query())  # type: ignore[no-untyped-call]

    def facts(self) -> FrameFacts:
        """What arrived."""
        pairs, _, chunks = self._numbers.tolist()
        return FrameFacts(self._size, self._capacity, pairs, chunks)


class Forecast:
    """The room that frames get: the most that was seen of late, with a margin, within a limit.

    Args:
        most_pairs: At a time, of which a frame's memory depends; a view of more is worked off in chunks.
    """

    def __init__(self, most_pairs: int = FEWEST_PAIRS) -> None:
        self.most_pairs = most_pairs
        self._readings: deque[PendingFacts] = deque()
        self._recent: FrameFacts | None = None  # the most of this window's frames
        self._before: FrameFacts | None = None  # of the one before it
        self._seen = 0  # frames in this window
        self._last = FrameAllocation(0, 0)
        self._last_count = 0
        self._lock = threading.Lock()  # pages of the viewer are rendered by several threads

    def room(self, size: FrameSize) -> FrameAllocation:
        """What the next frame gets; never waits."""
        with self._lock:
            return self._room(size)

    def _room(self, size: FrameSize) -> FrameAllocation:
        while self._readings and self._readings[0].arrived():
            self.learn(self._readings.popleft().facts())
        known = [facts for facts in (self._before, self._recent) if facts is not None]
        pairs = max((self._foreseen(facts, size) for facts in known), default=0)
        passes = 1
        if not known:
            pairs = max(FIRST_PAIRS_A_GAUSSIAN * size.count, FIRST_PAIRS_A_TILE * size.tiles)
            passes = FIRST_PASSES
        capacity = max(1, size.count, min(_rounded_up(pairs), self.most_pairs))
        chunks = max(-(-pairs // capacity), -(-size.tiles // MOST_TILES))
        if chunks > 1:
            chunks += 1  # chunks end with a tile, so that each has a little less than fits
        as_before = (facts.chunks for facts in known if facts.capacity >= capacity and facts.size.tiles == size.tiles)
        self._last = FrameAllocation(capacity, max(passes, chunks, *as_before))
        self._last_count = size.count
        return self._last

    def read_later(self, memory: Tensor, size: FrameSize, capacity: int) -> None:
        """Learn from a frame that was enqueued, when its facts have arrived."""
        self._readings.append(PendingFacts(memory, size, capacity))

    def learn(self, facts: FrameFacts) -> None:
        """Learn from a frame."""
        self._seen += 1
        if self._seen > WINDOW:
            self._before, self._recent, self._seen = self._recent, None, 1
        if self._recent is None or self._foreseen(self._recent, facts.size) <= facts.pairs * MARGIN:
            self._recent = facts

    def shrink(self) -> bool:
        """Halve the pairs that are held at a time, for memory is short; False if they are as few as they can be."""
        if self._last.capacity <= max(1, self._last_count):
            return False
        self.most_pairs = max(1, self._last_count, self._last.capacity // 2)
        return True

    @staticmethod
    def _foreseen(facts: FrameFacts, size: FrameSize) -> int:
        """Pairs by a frame of another size: as many more as it has more tiles and Gaussians, never fewer."""
        grown = max(1.0, size.tiles / max(1, facts.size.tiles)) * max(1.0, size.count / max(1, facts.size.count))
        return int(MARGIN * facts.pairs * grown)


def most_pairs_of(memory_bytes: int) -> int:
    """Pairs that a device holds at a time; where memory is short after all, they become fewer.

    Args:
        memory_bytes: The device's.
    """
    return min(MOST_PAIRS, max(FEWEST_PAIRS, int(MEMORY_SHARE * memory_bytes) // PAIR_BYTES))


def _rounded_up(pairs: int) -> int:
    """To the next of a few sizes an octave."""
    step = max(1, (1 << max(0, pairs.bit_length() - 1)) // STEPS_AN_OCTAVE)
    return -(-pairs // step) * step
