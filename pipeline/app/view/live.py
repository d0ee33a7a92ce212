"""The live view of training: progress, curves, and the latest model beside the photos."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from splatpipe.pipeline.app.view.log import RunLog, contents_of
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.runs.run_folder import EVENTS_FILE, Contents, RunFolder
from splatpipe.pipeline.engine.stage import JSON
from splatpipe.pipeline.photos.pixels.dataset import View

if TYPE_CHECKING:  # torch takes seconds to load, and marking does not need it
    from splatpipe.pipeline.app.view.checkpoint_render import LoadedModel, ModelSource

REFRESH_INTERVAL_S = 2.0
MAX_PICTURES = 64  # cached pairs of JPEGs of about 100 kB
RENDER_THREADS = 1  # the training needs the others
CURVES = ("loss", "gaussians")


class Live:
    """The content of the live page.

    Args:
        run: The run.
    """

    def __init__(self, run: RunFolder) -> None:
        self._run = run
        self._lock = threading.Lock()
        self._log = RunLog(run.out, EVENTS_FILE)
        self._contents = Contents()
        self._refreshed_s = -REFRESH_INTERVAL_S
        self._renderer = ThreadPoolExecutor(1, "render")  # one at a time
        self._model: tuple[str, LoadedModel] | None = None
        self._viewer: tuple[str, bytes, bytes] | None = None
        self._views: tuple[Path | None, tuple[View, ...]] = (None, ())
        self._pictures: OrderedDict[tuple[str, int], tuple[bytes, bytes]] = OrderedDict()

    def close(self) -> None:
        """End the renderer."""
        self._renderer.shutdown(wait=True, cancel_futures=True)

    def state(self) -> dict[str, JSON]:
        """The run's progress as JSON, for the page."""
        from splatpipe.pipeline.app.view import checkpoint_render

        with self._lock:
            self._log.read()
            contents, views = self._refresh()
            log = self._log
            source = checkpoint_render.newest(contents)
            held_out = set(checkpoint_render.held_out_of(contents))
            model: JSON = None
            if source is not None and views:
                model = {
                    "kind": source.kind,
                    "stamp": source.stamp,
                    "iteration": checkpoint_render.iteration_of(source),
                    "block": source.block,
                }
                model["in_3d"] = source.rendering is not None
            return {
                "name": self._run.name,
                "at_work": self._run.is_running,
                "finished": log.finished,
                "started_s": log.started_s,
                "last_s": log.last_s,
                "now_s": time.time(),
                "stages": [stage.as_json() for stage in log.stages.values()],
                "left_after_s": log.left_after_s,
                "curves": {name: log.curves[name].points for name in CURVES if name in log.curves},
                "curves_of": log.curves_of,
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

    def picture(self, number: int, what: str) -> bytes | None:
        """A JPEG of a view: its ``render`` by the latest model or its ``photo``; None if it does not exist.

        Raises:
            SplatpipeError: if it cannot be made.
        """
        jpegs = self._renderer.submit(self._render, number).result()
        return None if jpegs is None else jpegs[0 if what == "render" else 1]

    def viewer(self, what: str) -> bytes | None:
        """The 3D viewer of the latest model: its ``page``, or the ``splat`` that it loads; None if there is none.

        Raises:
            SplatpipeError: if it cannot be made.
        """
        files = self._renderer.submit(self._make_viewer).result()
        return None if files is None else files[0 if what == "page" else 1]

    def _make_viewer(self) -> tuple[bytes, bytes] | None:
        from splatpipe.pipeline.app.view import checkpoint_render

        with self._lock:
            contents, _ = self._refresh()
        source = checkpoint_render.newest(contents)
        if source is None:
            return None
        if self._viewer is None or self._viewer[0] != source.stamp:
            page, splat = checkpoint_render.viewer(self._load(source, contents), source, contents, self._run.name)
            self._viewer = source.stamp, page.encode(), splat
        return self._viewer[1:]

    def _load(self, source: ModelSource, contents: Contents) -> LoadedModel:
        from splatpipe.pipeline.app.view import checkpoint_render

        if self._model is None or self._model[0] != source.stamp:
            self._model = None  # two models may not fit in memory
            self._model = source.stamp, checkpoint_render.load(source, contents)
        return self._model[1]

    def _render(self, number: int) -> tuple[bytes, bytes] | None:
        from splatpipe.pipeline.app.view import checkpoint_render

        with self._lock:
            contents, views = self._refresh()
            device = checkpoint_render.device_of(contents, self._log.device)
        source = checkpoint_render.newest(contents)
        if source is None or not 0 <= number < len(views):
            return None
        if (source.stamp, number) in self._pictures:
            return self._pictures[source.stamp, number]
        loaded = self._load(source, contents)
        if loaded.megapixels is None:
            loaded = replace(loaded, megapixels=views[number].camera.width * views[number].camera.height / 1e6)
        jpegs = checkpoint_render.pictures(loaded, views[number], RENDER_THREADS, device)
        self._pictures[source.stamp, number] = jpegs
        while len(self._pictures) > MAX_PICTURES:
            self._pictures.popitem(last=False)
        return jpegs

    def _refresh(self) -> tuple[Contents, tuple[View, ...]]:
        """The run's contents and views, at most ``REFRESH_INTERVAL_S`` old; called with the lock held."""
        from splatpipe.pipeline.app.view import checkpoint_render

        if time.monotonic() - self._refreshed_s >= REFRESH_INTERVAL_S:
            self._contents = contents_of(self._run, self._log)
            self._refreshed_s = time.monotonic()
            part = self._contents.parts.get("undistort.dataset")
            path = None if part is None else part.path
            if path != self._views[0]:
                try:
                    self._views = path, checkpoint_render.views_of(self._contents)
                except SplatpipeError:
                    self._views = None, ()
        return self._contents, self._views[1]
