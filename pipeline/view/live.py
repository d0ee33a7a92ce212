"""The training as it runs: how far it is, its curves, and its latest model beside the photos."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.session import EVENTS_FILE
from splatpipe.pipeline.engine.stage import JSON
from splatpipe.pipeline.scene.dataset import View
from splatpipe.pipeline.view.log import RunLog
from splatpipe.pipeline.view.opened import Opened, Run

LOOK_EVERY_S = 2.0
MOST_PICTURES = 64  # that are kept: pairs of JPEGs of some 100 kB
RENDER_THREADS = 1  # the training wants the others
CURVES = ("loss", "gaussians")


class Live:
    """What the live page shows.

    Args:
        run: The run.
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        self._lock = threading.Lock()
        self._log = RunLog(run.out, EVENTS_FILE)
        self._opened = Opened({}, {}, {})
        self._looked_s = -LOOK_EVERY_S
        self._renderer = ThreadPoolExecutor(1, "render")  # one at a time
        self._model: tuple[str, object] | None = None
        self._views: tuple[Path | None, tuple[View, ...]] = (None, ())
        self._pictures: OrderedDict[tuple[str, int], tuple[bytes, bytes]] = OrderedDict()

    def close(self) -> None:
        """End the renderer."""
        self._renderer.shutdown(wait=True, cancel_futures=True)

    def state(self) -> dict[str, JSON]:
        """How far the run is, for the page."""
        from splatpipe.pipeline.view import checkpoint

        with self._lock:
            self._log.read()
            opened, views = self._look()
            log = self._log
            source = checkpoint.newest(opened)
            held_out = set(checkpoint.held_out_of(source))
            model = None
            if source is not None and views:
                model = {"kind": source.kind, "stamp": source.stamp, "iteration": checkpoint.iteration_of(source)}
            return {
                "name": self._run.name,
                "at_work": self._run.is_at_work(),
                "finished": log.finished,
                "started_s": log.started_s,
                "last_s": log.last_s,
                "now_s": time.time(),
                "stages": [stage.told() for stage in log.stages.values()],
                "curves": {name: log.curves[name].points for name in CURVES if name in log.curves},
                "notes": log.notes[-20:],
                "model": model,
                "views": [
                    {
                        "name": view.camera.name,
                        "width": view.camera.width,
                        "height": view.camera.height,
                        "held_out": view.camera.name in held_out,
                    }
                    for view in views
                ],
            }

    def picture(self, stamp: str, number: int, what: str) -> bytes | None:
        """A JPEG of a view: its ``render`` or its ``photo``; None where that model, or view, is no longer there.

        Raises:
            SplatpipeError: if it cannot be made.
        """
        made = self._pictures.get((stamp, number))
        if made is None:
            made = self._renderer.submit(self._make, stamp, number).result()
        return None if made is None else made[0 if what == "render" else 1]

    def _make(self, stamp: str, number: int) -> tuple[bytes, bytes] | None:
        from splatpipe.pipeline.view import checkpoint

        if (stamp, number) in self._pictures:
            return self._pictures[stamp, number]
        with self._lock:
            opened, views = self._look()
        source = checkpoint.newest(opened)
        if source is None or not 0 <= number < len(views):
            return None
        if self._model is None or self._model[0] != source.stamp:
            self._model = None  # two of them may not fit
            self._model = source.stamp, checkpoint.load(source, opened)
        if source.stamp != stamp:
            return None
        shown = self._model[1]
        assert isinstance(shown, checkpoint.Shown)
        if shown.megapixels is None:
            shown = replace(shown, megapixels=views[number].camera.width * views[number].camera.height / 1e6)
        made = checkpoint.pictures(shown, views[number], RENDER_THREADS)
        self._pictures[stamp, number] = made
        while len(self._pictures) > MOST_PICTURES:
            self._pictures.popitem(last=False)
        return made

    def _look(self) -> tuple[Opened, tuple[View, ...]]:
        """What there is, at most so old; called with the lock held."""
        from splatpipe.pipeline.view import checkpoint

        if time.monotonic() - self._looked_s >= LOOK_EVERY_S:
            self._opened = self._run.look()
            self._looked_s = time.monotonic()
            part = self._opened.parts.get("undistort.dataset")
            path = None if part is None else part.path
            if path != self._views[0]:
                try:
                    self._views = path, checkpoint.views_of(self._opened)
                except SplatpipeError:
                    self._views = None, ()
        return self._opened, self._views[1]
