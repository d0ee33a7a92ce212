"""Photos in training order, read slightly ahead; memory use does not grow with their number."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.dataset import View
from splatpipe.pipeline.photos.pixels.images import Mask, Pixels, reduced_view, reduced_views
from splatpipe.pipeline.train.photos.photo_cache import PhotoCache, stored_bytes
from splatpipe.pipeline.train.photos.upload import Upload, Uploader
from splatpipe.pipeline.train.plan.training_order import PhotoOrder, TrainingCrop, TrainingOrder
from splatpipe.pipeline.train.plan.windows import PixelRectangle, TrainingSize

EVERYWHERE = (slice(None), slice(None))  # rows and columns
READ_AHEAD = 3  # photos in flight: hides a slow decode behind an iteration


@dataclass(frozen=True)
class TrainingPhoto:
    """A photo, or a window of one, as used by the loss.

    Attributes:
        camera: Its camera, at the size of ``colour``; a window's camera knows the whole photo.
        colour: In [0, 1].
        mask: True where the photo counts; None if all of it does.
        is_empty: Whether no pixel counts; known without synchronizing with the device.
        inner: Left, top, right and bottom of the part that counts, in pixels of ``colour``; around it is the margin for
            SSIM. None if everything is inside.
        share: Share of the whole photo's counting pixels that are inside: the window's part in the photo's loss.
        round: Number of visits in the round that ends with this photo, as in ``TrainingCrop``; 0 if none ends.
    """

    camera: Camera
    colour: Float[Tensor, "h w 3"]
    mask: Bool[Tensor, "h w"] | None
    is_empty: bool = False
    inner: tuple[int, int, int, int] | None = None
    share: float = 1.0
    round: int = 0

    @property
    def inside(self) -> tuple[slice, slice]:
        """Rows and columns of the part that counts."""
        if self.inner is None:
            return EVERYWHERE
        left, top, right, bottom = self.inner
        return slice(top, bottom), slice(left, right)


PendingPhoto = tuple[Upload, Callable[[Tensor, Tensor | None], TrainingPhoto]]
"""A photo being uploaded, and what makes it of the uploaded colours and mask."""


class PhotoStream:
    """Iterates over the training photos, from one iteration to the last.

    Photos are decoded once, for all levels needed, into an unnamed file that disappears with the stream or its process;
    memory holds only the windows in flight. A photo that is needed only once is not stored. If the disk has no room for
    all, those that fit are stored and the others are decoded each time: slower, with the same result, and
    ``warn_if_disk_full`` warns about it. Photos that ``fill`` has not stored are decoded on first use.

    Args:
        views: The photos to train on.
        order: What each iteration trains on.
        first: The first iteration, from 1.
        cache: Folder on whose disk the decoded photos are kept.

    Raises:
        MachineError: if the folder cannot be written; from ``next``, if the disk is full all the same.
        StageError: from ``next``, if a photo is missing or broken.
    """

    def __init__(
        self,
        views: Sequence[View],
        order: TrainingOrder,
        first: int,
        cache: Path,
    ) -> None:
        self._views = views
        self._uploader = Uploader(torch.device("cpu"))
        self._pending: deque[Future[PendingPhoto]] = deque()
        self._reader = ThreadPoolExecutor(max_workers=1, thread_name_prefix="photos")
        self._cache = PhotoCache(cache)
        self.switch_order(order, first)

    def switch_order(self, order: TrainingOrder, first: int) -> None:
        """Switch to another order, as if the stream had started with it; photos read ahead are dropped.

        Args:
            order: What each iteration trains on, from 1.
            first: The next iteration.
        """
        for each in self._pending:
            each.cancel()
        wait(self._pending)  # the reader uses the fields changed below
        self._pending.clear()
        self._order, self._next = order, first
        wanted = order.levels_wanted(first).items()
        unread = {view: [level for level in levels if (view, level) not in self._cache] for view, levels in wanted}
        self._unread = {view: levels for view, levels in unread.items() if levels}

    @staticmethod
    def over(
        views: Sequence[View],
        sizes: Sequence[TrainingSize],
        seed: int,
        first: int,
        cache: Path,
        max_megapixels: float | None = None,
    ) -> PhotoStream:
        """A stream over whole photos; arguments as for the class and ``PhotoOrder``."""
        order = PhotoOrder([view.camera for view in views], sizes, seed, max_megapixels)
        return PhotoStream(views, order, first, cache)

    def to(self, device: torch.device) -> PhotoStream:
        """Return itself, set to put photos on a device; call it before taking the first photo."""
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
        while len(self._pending) < READ_AHEAD and self._next <= len(self._order):
            self._pending.append(self._reader.submit(self._photo, self._next))
            self._next += 1
        if not self._pending:
            raise StopIteration
        upload, photo = self._pending.popleft().result()
        return photo(*self._uploader.end(upload))

    def fill(self, report: Reporter) -> None:
        """Decode all photos before the first iteration: a full-size photo beside the model would take more memory.

        Raises:
            MachineError: if the disk is full.
            StageError: if a photo is missing or broken.
        """
        views = list(self._unread)
        for done, view in enumerate(views, 1):
            self._store(view)
            report.progress(done, len(views), "decoding photos", "photos")

    def wanted_bytes(self) -> int:
        """Disk space for all photos that are needed more than once and not stored yet, bytes."""
        return sum(
            stored_bytes(self._order.camera(view, level), self._views[view].mask_path is not None)
            for view, levels in self._unread.items()
            for level in levels
        )

    def warn_if_disk_full(self, report: Reporter) -> None:
        """Warn if the disk has no room for all decoded photos."""
        wanted, room = self.wanted_bytes(), self._cache.room_bytes
        if wanted > room:
            report.warning(
                f"The decoded photos take {wanted / 1e6:,.0f} MB, but the disk has room for {room / 1e6:,.0f} MB: "
                "those that do not fit are decoded every time they are trained on, which is slower.",
                hint="Free space on the disk of OUT, or lower train.max_megapixels.",
            )

    def _store(self, index: int) -> None:
        """Store a photo at all needed levels that fit."""
        view, levels = self._views[index], self._unread.pop(index, [])
        has_mask = view.mask_path is not None
        fitting = [level for level in levels if self._cache.has_room(self._order.camera(index, level), has_mask)]
        if not fitting:
            return
        for level, decoded in zip(fitting, reduced_views(view, self._order.max_megapixels, fitting), strict=True):
            self._cache.put((index, level), *decoded)

    def _photo(self, iteration: int) -> PendingPhoto:
        crop = self._order.at(iteration)
        window, whole = crop.window, crop.camera
        cut = window.grown(whole.width, whole.height)
        pixels, mask, of_whole = self._decoded(crop, cut)
        mask = crop.valid_mask(mask, cut)
        left, top, right, bottom = inner = window.within(cut)
        here = window.pixels if mask is None else int(np.count_nonzero(mask[top:bottom, left:right]))
        photo = partial(
            TrainingPhoto,
            whole.crop(cut.left, cut.top, cut.width, cut.height),
            is_empty=here == 0,
            inner=None if cut == window else inner,
            share=here / max(1, of_whole),
            round=crop.round,
        )
        return self._uploader.begin(pixels, mask), photo

    def _decoded(self, crop: TrainingCrop, cut: PixelRectangle) -> tuple[Pixels, Mask | None, int]:
        """A part of a photo, its mask, and the number of the whole photo's pixels that count."""
        if crop.view in self._unread:
            self._store(crop.view)
        key = (crop.view, crop.level)
        if key in self._cache:
            return *self._cache.get(key, cut), self._cache.valid_pixels(key)
        _, pixels, mask = reduced_view(self._views[crop.view], self._order.max_megapixels, crop.level)
        part = (slice(cut.top, cut.bottom), slice(cut.left, cut.right))
        if mask is None:
            return pixels[part], None, pixels.shape[0] * pixels.shape[1]
        return pixels[part], mask[part], int(np.count_nonzero(mask))
