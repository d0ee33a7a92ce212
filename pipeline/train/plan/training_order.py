"""The photo, size and window that each iteration trains on, known before the first iteration."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Int64

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.images import Mask, reduced_camera
from splatpipe.pipeline.train.plan.windows import PixelRectangle, TrainingSize, windows_of
from splatpipe.pipeline.train.random_numbers import WINDOW_ORDER, permutation, random_bits

MAX_WINDOWS = 1 << 20  # per photo: offset of the next photo's random numbers


@dataclass(frozen=True)
class TrainingCrop:
    """What an iteration trains on: a window of a photo.

    Attributes:
        view: Index of the photo.
        level: Number of times the photo is halved.
        camera: Camera of the whole photo at that size.
        window: The window that counts.
        cells: The part of the whole photo that counts besides its mask, as a grid of cells; None for all of it.
        round: If this iteration completes a round (everything at this size seen once), the round's length; 0
            otherwise. A round cut short by a change of size also counts.
    """

    view: int
    level: int
    camera: Camera
    window: PixelRectangle
    cells: Bool[np.ndarray, "rows columns"] | None = field(default=None, compare=False)
    round: int = field(default=0, compare=False)

    def valid_mask(self, mask: Mask | None, cut: PixelRectangle) -> Mask | None:
        """Mask of the pixels that count in a part of the photo; None if all do.

        Args:
            mask: The photo's mask in that part.
            cut: The part, in the camera's pixels.
        """
        if self.cells is None:
            return mask
        height, width = self.cells.shape
        rows = np.arange(cut.top, cut.bottom) * height // self.camera.height
        columns = np.arange(cut.left, cut.right) * width // self.camera.width
        if self.cells[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].all():
            return mask
        cells_mask: Mask = self.cells[rows][:, columns]
        return cells_mask if mask is None else cells_mask & mask


@runtime_checkable
class TrainingOrder(Protocol):
    """The order in which a training goes through its photos.

    Attributes:
        max_megapixels: The photos are first reduced to this size; None keeps the dataset's size.
    """

    max_megapixels: float | None

    def __len__(self) -> int:
        """How many iterations there are."""

    def at(self, iteration: int) -> TrainingCrop:
        """What an iteration, from 1, trains on."""

    def camera(self, view: int, level: int) -> Camera:
        """A photo's camera at a level."""

    def levels_wanted(self, first: int) -> dict[int, list[int]]:
        """The levels of each photo visited more than once from an iteration onward, finest first."""


class PhotoOrder(TrainingOrder):
    """Order of a training on whole photos: it depends only on the cameras, the training sizes and the seed.

    An epoch visits each photo once; a round visits each window of a photo at a level once; every epoch and round is
    shuffled anew. If photos have different numbers of windows, rounds run over the windows of all photos; otherwise
    those of the larger photos would be seen less often.

    Args:
        cameras: The photos' cameras.
        sizes: Training size of each iteration, ``sizes[i]`` for iteration ``i`` + 1.
        seed: Seed of the random order.
        max_megapixels: The photos are first reduced to this size; None keeps the dataset's size.
    """

    def __init__(
        self, cameras: Sequence[Camera], sizes: Sequence[TrainingSize], seed: int, max_megapixels: float | None = None
    ) -> None:
        self._cameras, self._sizes, self._seed, self.max_megapixels = cameras, sizes, seed, max_megapixels
        photos = len(cameras)
        epochs = [permutation(seed, epoch, photos) for epoch in range(-(-len(sizes) // max(1, photos)))]
        self._views = np.concatenate(epochs)[: len(sizes)] if epochs else np.zeros(0, np.int64)
        self._turns = np.zeros(len(sizes), np.int64)  # earlier visits of the same photo at the same size
        pixel_sizes = {
            (camera.width, camera.height, size.window_pixels)
            for size in set(sizes)
            for camera in (self.camera(view, size.level) for view in range(photos))
        }
        self._windows = {pixel_size: windows_of(*pixel_size) for pixel_size in pixel_sizes}
        self._given = np.full(len(sizes), -1, np.int64)  # windows that do not follow from the turn; -1: they do
        for size in sorted(set(sizes), key=lambda size: (size.level, size.window_pixels)):
            self._mix(size)
        before: Counter[tuple[int, TrainingSize]] = Counter()
        for place, key in enumerate(zip(self._views.tolist(), sizes, strict=True)):
            self._turns[place] = before[key]
            before[key] += 1
        self._rounds = rounds_ended(self._ends(), len(sizes))

    def _ends(self) -> Iterable[int]:
        """The iterations that end rounds: of photos, or of their windows if they have several."""
        photos = max(1, len(self._cameras))
        for size, begun, until in runs(self._sizes):
            counts = {len(self._windows_at(view, size)) for view in range(len(self._cameras))}
            if len(counts) == 1:  # epochs of photos, which a change of size does not restart
                begun = photos * -(-begun // photos)
            yield from range(begun, until + 1, self._count(size))

    def _count(self, size: TrainingSize) -> int:
        return max(1, sum(len(self._windows_at(view, size)) for view in range(len(self._cameras))))

    def _mix(self, size: TrainingSize) -> None:
        """Run rounds over the windows of all photos, if photos have different numbers of them."""
        counts = [len(self._windows_at(view, size)) for view in range(len(self._cameras))]
        if len(set(counts)) < 2:
            return
        pairs = np.array([(view, window) for view, count in enumerate(counts) for window in range(count)])
        places = np.array([place for place, each in enumerate(self._sizes) if each == size])
        rows = in_rounds(self._seed, len(pairs), len(places))
        self._views[places], self._given[places] = pairs[rows].T

    def _windows_at(self, view: int, size: TrainingSize) -> list[PixelRectangle]:
        camera = self.camera(view, size.level)
        return self._windows[camera.width, camera.height, size.window_pixels]

    def __len__(self) -> int:
        """How many iterations there are."""
        return len(self._sizes)

    def at(self, iteration: int) -> TrainingCrop:
        """What an iteration, from 1, trains on."""
        view, size = int(self._views[iteration - 1]), self._sizes[iteration - 1]
        camera, ended = self.camera(view, size.level), int(self._rounds[iteration - 1])
        windows, given = self._windows_at(view, size), int(self._given[iteration - 1])
        if len(windows) == 1 or given >= 0:
            return TrainingCrop(view, size.level, camera, windows[max(0, given)], round=ended)
        past, place = divmod(int(self._turns[iteration - 1]), len(windows))
        drawn = random_bits(self._seed, past, WINDOW_ORDER, view * MAX_WINDOWS + np.arange(len(windows)))
        return TrainingCrop(
            view, size.level, camera, windows[int(np.argsort(drawn, kind="stable")[place])], round=ended
        )

    def camera(self, view: int, level: int) -> Camera:
        """A photo's camera at a level."""
        return reduced_camera(self._cameras[view], self.max_megapixels, level)

    def levels_wanted(self, first: int) -> dict[int, list[int]]:
        """The levels of each photo visited more than once from an iteration onward, finest first."""
        return _revisited_photos(self._views[first - 1 :].tolist(), self._sizes[first - 1 :])


class WindowOrder(TrainingOrder):
    """Order of a training on given windows of photos: it depends only on these, the training sizes and the seed.

    A round visits each window of a level once, whichever photo it is from; every round is shuffled anew.

    Args:
        cameras: The photos' cameras.
        sizes: Training size of each iteration, ``sizes[i]`` for iteration ``i`` + 1.
        seed: Seed of the random order.
        max_megapixels: As for ``PhotoOrder``.
        parts: By level: pairs of a photo's index and a window at that level; at least one for each level in ``sizes``.
        cells: The part of each photo that counts, by photo index, as in ``TrainingCrop``; others count whole.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        sizes: Sequence[TrainingSize],
        seed: int,
        max_megapixels: float | None,
        parts: Mapping[int, Sequence[tuple[int, PixelRectangle]]],
        cells: Mapping[int, Bool[np.ndarray, "rows columns"]] | None = None,
    ) -> None:
        self._cameras, self._sizes, self.max_megapixels, self._parts = cameras, sizes, max_megapixels, parts
        self._cells = cells or {}
        levels = np.array([size.level for size in sizes], np.int64)
        self._rows = np.zeros(len(sizes), np.int64)  # rows of the level's parts
        for level in np.unique(levels).tolist():
            wanted, count = np.flatnonzero(levels == level), len(parts[level])
            self._rows[wanted] = in_rounds(seed, count, len(wanted))
        ends = (range(begun, until + 1, len(parts[size.level])) for size, begun, until in runs(sizes))
        self._rounds = rounds_ended((end for each in ends for end in each), len(sizes))

    def __len__(self) -> int:
        """How many iterations there are."""
        return len(self._sizes)

    def at(self, iteration: int) -> TrainingCrop:
        """What an iteration, from 1, trains on."""
        level = self._sizes[iteration - 1].level
        view, window = self._parts[level][int(self._rows[iteration - 1])]
        ended = int(self._rounds[iteration - 1])
        return TrainingCrop(view, level, self.camera(view, level), window, self._cells.get(view), ended)

    def camera(self, view: int, level: int) -> Camera:
        """A photo's camera at a level."""
        return reduced_camera(self._cameras[view], self.max_megapixels, level)

    def levels_wanted(self, first: int) -> dict[int, list[int]]:
        """The levels of each photo visited more than once from an iteration onward, finest first."""
        sizes, rows = self._sizes[first - 1 :], self._rows[first - 1 :].tolist()
        return _revisited_photos(
            [self._parts[size.level][row][0] for size, row in zip(sizes, rows, strict=True)], sizes
        )


def in_rounds(seed: int, count: int, visits: int) -> Int64[np.ndarray, " visits"]:
    """Indices below ``count``, each once per round; every round is shuffled anew."""
    rounds = [permutation(seed, turn, count) for turn in range(-(-visits // count))]
    return np.concatenate(rounds)[:visits]


def runs(sizes: Sequence[TrainingSize]) -> Iterable[tuple[TrainingSize, int, int]]:
    """Runs of equal training sizes, each with the number of iterations done before it and by its end."""
    done = 0
    for size, same in groupby(sizes):
        begun, done = done, done + sum(1 for _ in same)
        yield size, begun, done


def rounds_ended(ends: Iterable[int], visits: int) -> Int64[np.ndarray, " visits"]:
    """For each visit that ends a round, the number of visits since the previous one; 0 for all others.

    Args:
        ends: The iterations that end rounds, from 1, in any order and possibly repeated; 0 is ignored.
        visits: Number of visits.
    """
    found = np.zeros(visits, np.int64)
    places = np.array(sorted({0, *ends}), np.int64)
    found[places[1:] - 1] = np.diff(places)
    return found


def _revisited_photos(views: Sequence[int], sizes: Sequence[TrainingSize]) -> dict[int, list[int]]:
    """The photos visited more than once in these iterations, with their levels."""
    times: Counter[int] = Counter()
    levels: defaultdict[int, set[int]] = defaultdict(set)
    for view, size in zip(views, sizes, strict=True):
        times[view] += 1
        levels[view].add(size.level)
    return {view: sorted(levels[view]) for view in sorted(times) if times[view] > 1}
