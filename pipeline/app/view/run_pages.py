"""The pages that every view has, and the run's own files."""

from __future__ import annotations

import math
import time
from pathlib import Path, PurePosixPath
from typing import Any

import jinja2
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, Response
from starlette.routing import Route

from splatpipe.pipeline.app.serving.files import TYPES, FileAnswer, FileNotServedError, open_inside
from splatpipe.pipeline.app.view.access import Access
from splatpipe.pipeline.app.view.guard import CSP_OF_RUN, CSP_OF_SITE, FIRST_PAGE, OF_RUN
from splatpipe.pipeline.app.view.landing import downloadable_files, landing
from splatpipe.pipeline.app.view.live import Live
from splatpipe.pipeline.engine.runs.run_folder import RunFolder
from splatpipe.pipeline.web import asset
from splatpipe.pipeline.web.measured_page import SITE

ASSETS = {
    "landing.css": "text/css",
    "live.css": "text/css",
    "live.js": "text/javascript",
    "mark.css": "text/css",
    "mark.js": "text/javascript",
}
PAGE_OF_RUN = {**OF_RUN, "content-security-policy": CSP_OF_RUN}
PAGE_OF_SITE = {**OF_RUN, "content-security-policy": CSP_OF_SITE}
FILES_CACHED_S = 1.0  # the list of files is cached, since a page may request thousands of files
ALONE = {"cross-origin-opener-policy": "same-origin"}  # a page that opened it, or that it opens, has no handle of it


class Pages:
    """The pages that every view has.

    Args:
        run: The run.
        live: Its training.
        access: The server's secrets: its addresses are below them.
    """

    marking = False

    def __init__(self, run: RunFolder, live: Live, access: Access) -> None:
        self.run, self.live, self._access = run, live, access
        self._known: tuple[float, frozenset[str]] = (-math.inf, frozenset())
        folder = Path(__file__).parent / "pages"
        self._templates = jinja2.Environment(loader=jinja2.FileSystemLoader(folder), autoescape=True)

    def routes(self) -> list[Route]:
        """The routes of our pages."""
        return [
            Route(f"/{FIRST_PAGE}", self._landing),
            Route("/live", self._live),
            Route("/api/live", self._state),
            Route(
                "/live/{stamp}/{number:int}/{what}.jpg", self._picture
            ),  # the page sets the stamp: a new one means new images
            Route("/assets/{name}", self._asset),
        ]

    def files(self) -> list[Route]:
        """The routes of what the run itself made."""
        return [
            Route("/live/{stamp}/viewer.html", self._viewer),
            Route("/live/{stamp}/splat.spz", self._splat),
            Route("/{path:path}", self._file),
        ]

    def page(self, template: str, values: dict[str, Any]) -> Response:
        """Render one of our pages."""
        style = PurePosixPath(template).stem
        text = self._templates.get_template(template).render(style=style, folder=f"/{self._access.files}", **values)
        return HTMLResponse(text, headers=ALONE)

    def _landing(self, _request: Request) -> Response:
        return self.page("landing.html", landing(self.run, self.marking))

    def _live(self, _request: Request) -> Response:
        return self.page("live.html", {"name": self.run.name})

    def _state(self, _request: Request) -> Response:
        return JSONResponse(self.live.state())

    def _picture(self, request: Request) -> Response:
        given = request.path_params
        if given["what"] not in ("render", "photo"):
            raise HTTPException(404)
        made = self.live.picture(given["number"], given["what"])
        if made is None:
            raise HTTPException(404)
        return Response(made, media_type="image/jpeg", headers={"cache-control": "no-store"})

    def _viewer(self, _request: Request) -> Response:
        page = self.live.viewer("page")
        if page is None:
            raise HTTPException(404)
        return Response(page, media_type="text/html", headers=PAGE_OF_RUN)

    def _splat(self, _request: Request) -> Response:
        splat = self.live.viewer("splat")
        if splat is None:
            raise HTTPException(404)
        return Response(splat, media_type="application/octet-stream", headers=PAGE_OF_RUN)

    def _asset(self, request: Request) -> Response:
        name = request.path_params["name"]
        if name not in ASSETS:
            raise HTTPException(404)
        return Response(asset(name), media_type=ASSETS[name])

    def _file(self, request: Request) -> Response:
        """A deliverable of the run; its name is only compared with the known ones."""
        path = request.path_params["path"]
        if path not in self._downloadable_files():
            raise HTTPException(404)
        try:
            file = open_inside(self.run.out, path)
        except FileNotServedError as error:
            raise HTTPException(404) from error
        kind = TYPES.get(PurePosixPath(path).suffix, "application/octet-stream")
        return FileAnswer(file, kind, PAGE_OF_SITE if path.startswith(SITE) else PAGE_OF_RUN)

    def _downloadable_files(self) -> frozenset[str]:
        now = time.monotonic()
        since, names = self._known
        if now - since > FILES_CACHED_S:
            names = frozenset(downloadable_files(self.run))
            self._known = now, names
        return names
