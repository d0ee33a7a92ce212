"""Photos in the order of training, read a little ahead; memory does not grow with their number."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.dataset import View
from splatpipe.pipeline.photos.images import Mask, Pixels, reduced_camera, reduced_view
from splatpipe.pipeline.train.draws import permutation
from splatpipe.pipeline.train.looks import Look
from splatpipe.pipeline.train.photo_cache import PhotoCache, stored_bytes
from splatpipe.pipeline.train.upload import Upload, Uploader

READ_AHEAD = 3  # photos in flight: hides a slow decode behind an iteration


@dataclass(frozen=True)
class TrainingPhoto:
    """A photo as the loss wants it.

    Attributes:
        camera: Its camera, at the size of ``colour``.
        colour: In [0, 1].
        mask: True where the photo counts; None where all of it does.
        is_empty: Nothing of it counts; known without asking the device.
    """

    camera: Camera
    colour: Float[Tensor, "h w 3"]
    mask: Bool[Tensor, "h w"] | None
    is_empty: bool = False


class PhotoStream:
    """Iterates over the photos of training, from one iteration to the last.

    The photo of an iteration depends on the views, the seed and the iteration alone. A thread of its own decodes each
    photo once a size, when it is first wanted, into a file without a name that is gone with the stream or its process;
    memory holds the photos in flight and no more. A photo that is wanted only once is not stored. Where the disk has no
    room for all, those that fit are stored and the others decoded each time: slower, with the same result, and
    ``tell`` says so.

    Args:
        views: The photos to train on.
        looks: What each iteration looks at of its photo, ``looks[i]`` for iteration ``i`` + 1.
        seed: Of the order; each epoch has its own.
        first: The first iteration, from 1.
        cache: Folder on whose disk the decoded photos lie meanwhile.
        max_megapixels: The photos are first reduced to this size; None: they are as the dataset has them.

    Raises:
        MachineError: if the folder cannot be written; from ``next``, if the disk is full all the same.
        StageError: from ``next``, if a photo is missing or broken.
    """

    def __init__(
        self,
        views: Sequence[View],
        looks: Sequence[Look],
        seed: int,
        first: int,
        cache: Path,
        max_megapixels: float | None = None,
    ) -> None:
        self._views = views
        self._looks = looks
        self._seed = seed
        self._next = first
        self._max_megapixels = max_megapixels
        self._uploader = Uploader(torch.device("cpu"))
        self._pending: deque[Future[tuple[Camera, Upload, bool]]] = deque()
        self._epoch = (-1, np.zeros(0, np.int64))
        wanted = Counter(self._key(iteration) for iteration in range(first, len(looks) + 1))
        self._wanted_again = {key for key, times in wanted.items() if times > 1}
        self._reader = ThreadPoolExecutor(max_workers=1, thread_name_prefix="photos")
        self._cache = PhotoCache(cache)

    def to(self, device: torch.device) -> PhotoStream:
        """Itself, with photos on a device; before the first of them."""
        self._uploader = Uploader(device)
        return self

    def __enter__(self) -> PhotoStream:
        return self

    def __exit__(self, *unused: object) -> None:
        self._reader.shutdown(wait=True, cancel_futures=True)
        self._cache.close()

    def __iter__(self) -> Iterator[TrainingPhoto]:
        return self

    def __next__(self) -> TrainingPhoto:
        while len(self._pending) < READ_AHEAD and self._next <= len(self._looks):
            self._pending.append(self._reader.submit(self._photo, self._next))
            self._next += 1
        if not self._pending:
            raise StopIteration
        camera, upload, is_empty = self._pending.popleft().result()
        return TrainingPhoto(camera, *self._uploader.end(upload), is_empty)

    def view_index(self, iteration: int) -> int:
        """Which view an iteration (from 1) is trained on."""
        epoch, place = divmod(iteration - 1, len(self._views))
        if self._epoch[0] != epoch:
            self._epoch = (epoch, permutation(self._seed, epoch, len(self._views)))
        return int(self._epoch[1][place])

    def wanted_bytes(self) -> int:
        """What all photos that are wanted more than once take on the disk."""
        wanted = 0
        for index, level in self._wanted_again:
            view = self._views[index]
            camera = reduced_camera(view.camera, self._max_megapixels, level)
            wanted += stored_bytes(camera, view.mask_path is not None)
        return wanted

    def tell(self, report: Reporter) -> None:
        """Warn where the disk has no room for all decoded photos."""
        wanted, room = self.wanted_bytes(), self._cache.room_bytes
        if wanted > room:
            report.warning(
                f"The decoded photos take {wanted / 1e6:,.0f} MB, and the disk has room for {room / 1e6:,.0f} MB: "
                "those that do not fit are decoded every time they are trained on, which is slower.",
                hint="Make room on the disk of OUT, or lower undistort.max_megapixels.",
            )

    def _key(self, iteration: int) -> tuple[int, int]:
        return self.view_index(iteration), self._looks[iteration - 1].level

    def _photo(self, iteration: int) -> tuple[Camera, Upload, bool]:
        camera, pixels, mask = self._decoded(self._key(iteration))
        return camera, self._uploader.begin(pixels, mask), mask is not None and not mask.any()

    def _decoded(self, key: tuple[int, int]) -> tuple[Camera, Pixels, Mask | None]:
        stored = self._cache.get(key)
        if stored is not None:
            return stored
        decoded = reduced_view(self._views[key[0]], self._max_megapixels, key[1])
        if key in self._wanted_again:
            self._cache.put(key, *decoded)
        return decoded
