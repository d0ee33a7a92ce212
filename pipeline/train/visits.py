"""Which photo, at which size, and which window of it each iteration looks at: known before the first one."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.images import reduced_camera
from splatpipe.pipeline.train.draws import WINDOW_ORDER, permutation, random_bits
from splatpipe.pipeline.train.looks import Frame, Look, windows_of

MOST_WINDOWS = 1 << 20  # of a photo: where the next one's random numbers begin


@dataclass(frozen=True)
class Visit:
    """What an iteration looks at.

    Attributes:
        view: The photo's number.
        level: How often it is halved.
        camera: The whole photo's, of that size.
        window: What counts.
    """

    view: int
    level: int
    camera: Camera
    window: Frame


class Visits:
    """The visits of a training: they depend on the cameras, the looks, the seed and the iteration alone.

    Photos go by epochs, each once; the windows of a photo at a level go by rounds, each once; every epoch and every
    round has an order of its own.

    Args:
        cameras: Of the photos.
        looks: Of each iteration, ``looks[i]`` for iteration ``i`` + 1.
        seed: Of the orders.
        max_megapixels: The photos are first reduced to this size; None: they are as the dataset has them.
    """

    def __init__(
        self, cameras: Sequence[Camera], looks: Sequence[Look], seed: int, max_megapixels: float | None = None
    ) -> None:
        self._cameras, self._looks, self._seed, self._max_megapixels = cameras, looks, seed, max_megapixels
        photos = len(cameras)
        epochs = [permutation(seed, epoch, photos) for epoch in range(-(-len(looks) // max(1, photos)))]
        self._views = np.concatenate(epochs)[: len(looks)] if epochs else np.zeros(0, np.int64)
        self._turns = np.zeros(len(looks), np.int64)  # visits of the same photo with the same look before each
        sizes = {
            (camera.width, camera.height, look.window_pixels)
            for look in set(looks)
            for camera in (self.camera(view, look.level) for view in range(photos))
        }
        self._windows = {size: windows_of(*size) for size in sizes}
        before: Counter[tuple[int, Look]] = Counter()
        for place, key in enumerate(zip(self._views.tolist(), looks, strict=True)):
            self._turns[place] = before[key]
            before[key] += 1

    def __len__(self) -> int:
        """How many iterations there are."""
        return len(self._looks)

    def at(self, iteration: int) -> Visit:
        """The visit of an iteration, from 1."""
        view, look = int(self._views[iteration - 1]), self._looks[iteration - 1]
        camera = self.camera(view, look.level)
        windows = self._windows[camera.width, camera.height, look.window_pixels]
        if len(windows) == 1:
            return Visit(view, look.level, camera, windows[0])
        past, place = divmod(int(self._turns[iteration - 1]), len(windows))
        drawn = random_bits(self._seed, past, WINDOW_ORDER, view * MOST_WINDOWS + np.arange(len(windows)))
        return Visit(view, look.level, camera, windows[int(np.argsort(drawn, kind="stable")[place])])

    def camera(self, view: int, level: int) -> Camera:
        """A photo's camera at a level."""
        return reduced_camera(self._cameras[view], self._max_megapixels, level)

    def levels_wanted(self, first: int) -> dict[int, list[int]]:
        """The levels of each photo that is looked at more than once from an iteration on, finest first."""
        times: Counter[int] = Counter()
        levels: defaultdict[int, set[int]] = defaultdict(set)
        for view, look in zip(self._views[first - 1 :].tolist(), self._looks[first - 1 :], strict=True):
            times[view] += 1
            levels[view].add(look.level)
        return {view: sorted(levels[view]) for view in sorted(times) if times[view] > 1}
