"""Forecast of the next frame's Gaussian-tile pairs from earlier frames, so that the host never waits for a count.

Pairs beyond the forecast are still rendered, with identical bits, a little more slowly (see native/cuda).
"""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass

import torch
from torch import Tensor

from splatpipe.pipeline.raster.cuda.cuda_api import SplatFrameFacts

FIRST_PAIRS_A_GAUSSIAN = 8  # for a first frame; a trained Gaussian touches 3 to 10 tiles
FIRST_PAIRS_A_TILE = 64  # for a start with few, large Gaussians, which fill the tiles
FIRST_PASSES = 8  # once: a wrong guess then costs empty launches, and the launch for the rest is slower
CAPACITY_MARGIN = 1.25  # capacity over the recent maximum: views differ, and the model grows
WINDOW_FRAMES = 512  # frames after which older maxima start to be forgotten: more than most trainings have photos
PAIR_BYTES = 64  # per pair, in the frame and its backward pass
MEMORY_SHARE = 1 / 16  # share of the device's memory for pairs: several chunks are binned twice, so prefer a single one
MIN_PAIRS, MAX_PAIRS = 1 << 22, 1 << 28  # at a time: for a small device, filling it; and 17 GB of them
STEPS_AN_OCTAVE = 8  # sizes that capacities are rounded up to, so that torch's allocator reuses the last frame's memory
MAX_TILES = 1 << 16  # per chunk, as in frame.h


@dataclass(frozen=True)
class FrameSize:
    """What is known of a frame before it is rendered.

    Attributes:
        count: Number of Gaussians.
        tiles: Number of tiles of the image.
    """

    count: int
    tiles: int


@dataclass(frozen=True)
class FrameAllocation:
    """The allocation of a frame.

    Attributes:
        capacity: Number of pairs that it holds at a time.
        passes: Number of chunks that get launches of their own.
    """

    capacity: int
    passes: int


@dataclass(frozen=True)
class FrameFacts:
    """What a frame actually used.

    Attributes:
        size: The requested size.
        capacity: The allocated capacity.
        pairs: Total number of pairs.
        chunks: Number of chunks that they took at that capacity.
    """

    size: FrameSize
    capacity: int
    pairs: int
    chunks: int


class PendingFacts:
    """Facts being copied from the device.

    Args:
        memory: The frame's memory, which begins with the facts; the frame is enqueued on its device's current stream.
        size: Size of the frame.
        capacity: Capacity of the frame.
    """

    def __init__(self, memory: Tensor, size: FrameSize, capacity: int) -> None:
        self._size, self._capacity = size, capacity
        numbers = len(SplatFrameFacts._fields_)
        on_cuda = memory.device.type == "cuda"
        self._numbers = torch.empty(numbers, dtype=torch.int64, pin_memory=on_cuda)
        self._numbers.copy_(memory[: 8 * numbers].view(torch.int64), non_blocking=True)
        self._event = torch.cuda.Event() if on_cuda else None  # type: ignore[no-untyped-call]
        if self._event is not None:
            self._event.record(torch.cuda.current_stream(memory.device))

    def arrived(self) -> bool:
        """Whether the facts can be read without waiting."""
        return self._event is None or bool(self._event.query())  # type: ignore[no-untyped-call]

    def facts(self) -> FrameFacts:
        """The facts; call after ``arrived``."""
        pairs, _, chunks = self._numbers.tolist()
        return FrameFacts(self._size, self._capacity, pairs, chunks)


class Forecast:
    """Forecasts frame allocations: the recent maximum with a margin, within a limit.

    Args:
        most_pairs: Maximum number of pairs at a time, which determines a frame's memory; views with more are processed
            in chunks.
    """

    def __init__(self, most_pairs: int = MIN_PAIRS) -> None:
        self.most_pairs = most_pairs
        self._readings: deque[PendingFacts] = deque()
        self._recent: FrameFacts | None = None  # the most of this window's frames
        self._before: FrameFacts | None = None  # the most of the preceding window's frames
        self._seen = 0  # frames in this window
        self._last = FrameAllocation(0, 0)
        self._last_count = 0
        self._lock = threading.Lock()  # pages of the viewer are rendered by several threads

    def room(self, size: FrameSize) -> FrameAllocation:
        """The allocation of the next frame; never waits."""
        with self._lock:
            return self._room(size)

    def _room(self, size: FrameSize) -> FrameAllocation:
        while self._readings and self._readings[0].arrived():
            self.update(self._readings.popleft().facts())
        known = [facts for facts in (self._before, self._recent) if facts is not None]
        pairs = max((self._foreseen(facts, size) for facts in known), default=0)
        passes = 1
        if not known:
            pairs = max(FIRST_PAIRS_A_GAUSSIAN * size.count, FIRST_PAIRS_A_TILE * size.tiles)
            passes = FIRST_PASSES
        capacity = max(1, size.count, min(_rounded_up(pairs), self.most_pairs))
        chunks = max(-(-pairs // capacity), -(-size.tiles // MAX_TILES))
        if chunks > 1:
            chunks += 1  # chunks end with a tile, so that each has a little less than fits
        as_before = (facts.chunks for facts in known if facts.capacity >= capacity and facts.size.tiles == size.tiles)
        self._last = FrameAllocation(capacity, max(passes, chunks, *as_before))
        self._last_count = size.count
        return self._last

    def read_later(self, memory: Tensor, size: FrameSize, capacity: int) -> None:
        """Learn from an enqueued frame once its facts have arrived."""
        self._readings.append(PendingFacts(memory, size, capacity))

    def update(self, facts: FrameFacts) -> None:
        """Learn from a frame."""
        self._seen += 1
        if self._seen > WINDOW_FRAMES:
            self._before, self._recent, self._seen = self._recent, None, 1
        if self._recent is None or self._foreseen(self._recent, facts.size) <= facts.pairs * CAPACITY_MARGIN:
            self._recent = facts

    def shrink(self) -> bool:
        """Halve the pairs held at a time, because memory is short; False if they are already at the minimum."""
        if self._last.capacity <= max(1, self._last_count):
            return False
        self.most_pairs = max(1, self._last_count, self._last.capacity // 2)
        return True

    @staticmethod
    def _foreseen(facts: FrameFacts, size: FrameSize) -> int:
        """Pairs forecast from a frame of another size: scaled up with tiles and Gaussians, never down."""
        grown = max(1.0, size.tiles / max(1, facts.size.tiles)) * max(1.0, size.count / max(1, facts.size.count))
        return int(CAPACITY_MARGIN * facts.pairs * grown)


def most_pairs_of(memory_bytes: int) -> int:
    """Maximum pairs that a device holds at a time; reduced later if memory is short after all.

    Args:
        memory_bytes: The device's memory.
    """
    return min(MAX_PAIRS, max(MIN_PAIRS, int(MEMORY_SHARE * memory_bytes) // PAIR_BYTES))


def _rounded_up(pairs: int) -> int:
    """Rounded up to the next of ``STEPS_AN_OCTAVE`` sizes per octave."""
    step = max(1, (1 << max(0, pairs.bit_length() - 1)) // STEPS_AN_OCTAVE)
    return -(-pairs // step) * step
