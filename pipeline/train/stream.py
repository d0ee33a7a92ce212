"""Photos in the order of training, read a little ahead; memory does not grow with their number."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.dataset import View
from splatpipe.pipeline.photos.images import Mask, Pixels, reduced_view, reduced_views
from splatpipe.pipeline.train.photo_cache import PhotoCache, stored_bytes
from splatpipe.pipeline.train.upload import Upload, Uploader
from splatpipe.pipeline.train.visits import PhotoVisits, Visit, Visits
from splatpipe.pipeline.train.windows import PixelRectangle, TrainingSize

EVERYWHERE = (slice(None), slice(None))  # rows and columns
READ_AHEAD = 3  # photos in flight: hides a slow decode behind an iteration


@dataclass(frozen=True)
class TrainingPhoto:
    """A photo, or a window of one, as the loss wants it.

    Attributes:
        camera: Its camera, at the size of ``colour``; a window's knows the whole photo.
        colour: In [0, 1].
        mask: True where the photo counts; None where all of it does.
        is_empty: Nothing of it counts; known without asking the device.
        inner: Left, top, right and bottom of what counts, in the pixels of ``colour``: around it is what SSIM looks at
            beside; None where all is inside.
        share: Of the pixels of the whole photo that count, how many are inside: a window's part in the photo's loss.
        round: How many visits the round took that ends with it, as of ``Visit``; 0 where none does.
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
        """Rows and columns of what counts."""
        if self.inner is None:
            return EVERYWHERE
        left, top, right, bottom = self.inner
        return slice(top, bottom), slice(left, right)


@dataclass(frozen=True)
class _PendingPhoto:
    """A photo on its way, and what it will be."""

    camera: Camera
    upload: Upload
    is_empty: bool
    inner: tuple[int, int, int, int] | None
    share: float
    round: int


class PhotoStream:
    """Iterates over the photos of training, from one iteration to the last.

    Photos are decoded once, for all the levels that are wanted of them, into a file without a name that is gone with
    the stream or its process; memory holds the windows in flight and no more. A photo that is wanted only once is not
    stored. Where the disk has no room for all, those that fit are stored and the others decoded each time: slower, with
    the same result, and ``tell`` says so. What ``fill`` has not stored is decoded when it is first wanted.

    Args:
        views: The photos to train on.
        visits: What each iteration looks at of them.
        first: The first iteration, from 1.
        cache: Folder on whose disk the decoded photos lie meanwhile.

    Raises:
        MachineError: if the folder cannot be written; from ``next``, if the disk is full all the same.
        StageError: from ``next``, if a photo is missing or broken.
    """

    def __init__(
        self,
        views: Sequence[View],
        visits: Visits,
        first: int,
        cache: Path,
    ) -> None:
        self._views = views
        self._uploader = Uploader(torch.device("cpu"))
        self._pending: deque[Future[_PendingPhoto]] = deque()
        self._reader = ThreadPoolExecutor(max_workers=1, thread_name_prefix="photos")
        self._cache = PhotoCache(cache)
        self.go_on(visits, first)

    def go_on(self, visits: Visits, first: int) -> None:
        """Go on with other visits, as if the stream had been begun with them; what was read ahead is dropped.

        Args:
            visits: Of all iterations from 1.
            first: The next iteration.
        """
        for each in self._pending:
            each.cancel()
        wait(self._pending)  # the reader uses what changes now
        self._pending.clear()
        self._visits, self._next = visits, first
        wanted = visits.levels_wanted(first).items()
        unread = {view: [level for level in levels if (view, level) not in self._cache] for view, levels in wanted}
        self._unread = {view: levels for view, levels in unread.items() if levels}

    @staticmethod
    def over(
        views: Sequence[View],
        looks: Sequence[TrainingSize],
        seed: int,
        first: int,
        cache: Path,
        max_megapixels: float | None = None,
    ) -> PhotoStream:
        """All that the photos show; arguments as of the stream and of ``PhotoVisits``."""
        visits = PhotoVisits([view.camera for view in views], looks, seed, max_megapixels)
        return PhotoStream(views, visits, first, cache)

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
        while len(self._pending) < READ_AHEAD and self._next <= len(self._visits):
            self._pending.append(self._reader.submit(self._photo, self._next))
            self._next += 1
        if not self._pending:
            raise StopIteration
        sent = self._pending.popleft().result()
        pixels = self._uploader.end(sent.upload)
        return TrainingPhoto(sent.camera, *pixels, sent.is_empty, sent.inner, sent.share, sent.round)

    def fill(self, report: Reporter) -> None:
        """Decode all photos before the first iteration: one at full size beside the model would take more memory.

        Raises:
            MachineError: if the disk is full.
            StageError: if a photo is missing or broken.
        """
        views = list(self._unread)
        for done, view in enumerate(views, 1):
            self._store(view)
            report.progress(done, len(views), "decoding photos", "photos")

    def wanted_bytes(self) -> int:
        """What all photos that are wanted more than once, and are not stored yet, take on the disk."""
        return sum(
            stored_bytes(self._visits.camera(view, level), self._views[view].mask_path is not None)
            for view, levels in self._unread.items()
            for level in levels
        )

    def tell(self, report: Reporter) -> None:
        """Warn where the disk has no room for all decoded photos."""
        wanted, room = self.wanted_bytes(), self._cache.room_bytes
        if wanted > room:
            report.warning(
                f"The decoded photos take {wanted / 1e6:,.0f} MB, but the disk has room for {room / 1e6:,.0f} MB: "
                "those that do not fit are decoded every time they are trained on, which is slower.",
                hint="Free space on the disk of OUT, or lower train.max_megapixels.",
            )

    def _store(self, index: int) -> None:
        """Store a photo at all the levels that are wanted and have room."""
        view, levels = self._views[index], self._unread.pop(index, [])
        has_mask = view.mask_path is not None
        fitting = [level for level in levels if self._cache.has_room(self._visits.camera(index, level), has_mask)]
        if not fitting:
            return
        for level, decoded in zip(fitting, reduced_views(view, self._visits.max_megapixels, fitting), strict=True):
            self._cache.put((index, level), *decoded)

    def _photo(self, iteration: int) -> _PendingPhoto:
        visit = self._visits.at(iteration)
        window, whole = visit.window, visit.camera
        cut = window.grown(whole.width, whole.height)
        pixels, mask, of_whole = self._decoded(visit, cut)
        mask = visit.counted(mask, cut)
        left, top, right, bottom = inner = window.within(cut)
        here = window.pixels if mask is None else int(np.count_nonzero(mask[top:bottom, left:right]))
        return _PendingPhoto(
            whole.cut(cut.left, cut.top, cut.width, cut.height),
            self._uploader.begin(pixels, mask),
            here == 0,
            None if cut == window else inner,
            here / max(1, of_whole),
            visit.round,
        )

    def _decoded(self, visit: Visit, cut: PixelRectangle) -> tuple[Pixels, Mask | None, int]:
        """A part of a photo, and how many of the whole photo's pixels count."""
        if visit.view in self._unread:
            self._store(visit.view)
        key = (visit.view, visit.level)
        if key in self._cache:
            return *self._cache.get(key, cut), self._cache.counted(key)
        _, pixels, mask = reduced_view(self._views[visit.view], self._visits.max_megapixels, visit.level)
        part = (slice(cut.top, cut.bottom), slice(cut.left, cut.right))
        if mask is None:
            return pixels[part], None, pixels.shape[0] * pixels.shape[1]
        return pixels[part], mask[part], int(np.count_nonzero(mask))
