"""Photos in the order of training, decoded a little ahead; memory does not grow with their number."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatpipe.pipeline.scene.camera import Camera
from splatpipe.pipeline.scene.dataset import View
from splatpipe.pipeline.scene.images import Mask, Pixels, reduced_view
from splatpipe.stages.train.draws import permutation

CACHE_BYTES = 512 << 20  # some 400 photos of 0.4 MP; more are decoded again, a few milliseconds each
READ_AHEAD = 3  # photos in flight: hides a slow decode behind an iteration


@dataclass(frozen=True)
class TrainingPhoto:
    """A photo as the loss wants it.

    Attributes:
        camera: Its camera, at the size of ``colour``.
        colour: In [0, 1].
        mask: True where the photo counts; None where all of it does.
    """

    camera: Camera
    colour: Float[Tensor, "h w 3"]
    mask: Bool[Tensor, "h w"] | None


class PhotoStream:
    """Iterates over the photos of training, from one iteration to the last.

    Args:
        views: The photos to train on.
        levels: How often each iteration's photo is halved, ``levels[i]`` for iteration ``i`` + 1.
        seed: Of the order; each epoch has its own.
        first: The first iteration, from 1.
        cache_bytes: Decoded photos kept.
        max_megapixels: Photos are reduced to at most so many; None for the dataset's size.
    """

    def __init__(
        self,
        views: Sequence[View],
        levels: Sequence[int],
        seed: int,
        first: int = 1,
        cache_bytes: int = CACHE_BYTES,
        max_megapixels: float | None = None,
    ) -> None:
        self._max_megapixels = max_megapixels
        self._views = views
        self._levels = levels
        self._seed = seed
        self._next = first
        self._pending: deque[Future[TrainingPhoto]] = deque()
        self._cache: OrderedDict[tuple[int, int], tuple[Camera, Pixels, Mask | None]]
        self._cache = OrderedDict()
        self._cache_room = cache_bytes
        self._epoch = (-1, np.zeros(0, np.int64))
        self._reader = ThreadPoolExecutor(max_workers=1, thread_name_prefix="photos")

    def __enter__(self) -> PhotoStream:
        return self

    def __exit__(self, *unused: object) -> None:
        self._reader.shutdown(wait=True, cancel_futures=True)

    def __iter__(self) -> Iterator[TrainingPhoto]:
        return self

    def __next__(self) -> TrainingPhoto:
        while len(self._pending) < READ_AHEAD and self._next <= len(self._levels):
            self._pending.append(self._reader.submit(self._photo, self._next))
            self._next += 1
        if not self._pending:
            raise StopIteration
        return self._pending.popleft().result()

    def view_index(self, iteration: int) -> int:
        """Which view an iteration (from 1) is trained on."""
        epoch, place = divmod(iteration - 1, len(self._views))
        if self._epoch[0] != epoch:
            self._epoch = (epoch, permutation(self._seed, epoch, len(self._views)))
        return int(self._epoch[1][place])

    def cached_bytes(self) -> int:
        """Memory that decoded photos take now."""
        return sum(pixels.nbytes for _, pixels, _ in self._cache.values())

    def _photo(self, iteration: int) -> TrainingPhoto:
        key = (self.view_index(iteration), self._levels[iteration - 1])
        entry = self._cache.get(key)
        if entry is None:
            entry = reduced_view(self._views[key[0]], self._max_megapixels, key[1])
            self._keep(key, entry)
        else:
            self._cache.move_to_end(key)
        camera, pixels, mask = entry
        colour = torch.from_numpy(pixels.astype(np.float32) * np.float32(1.0 / 255.0))
        return TrainingPhoto(camera, colour, None if mask is None else torch.from_numpy(mask))

    def _keep(self, key: tuple[int, int], entry: tuple[Camera, Pixels, Mask | None]) -> None:
        self._cache_room -= entry[1].nbytes
        self._cache[key] = entry
        while self._cache_room < 0 and self._cache:
            _, (_, dropped, _) = self._cache.popitem(last=False)
            self._cache_room += dropped.nbytes
