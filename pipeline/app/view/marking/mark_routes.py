"""The HTTP routes of the page for marking control points."""

from __future__ import annotations

import json
from typing import Any

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from splatpipe.pipeline.app.view.marking.marking import Change, Marking, State, WrongRequestError
from splatpipe.pipeline.app.view.marking.photo import photo_for_browser
from splatpipe.pipeline.app.view.run_pages import Pages

ACTIONS = ("mark", "unmark", "hide")


class MarkPages:
    """Marking over HTTP; points and photos are identified by number.

    Args:
        marking: The session.
        pages: The other pages.
    """

    def __init__(self, marking: Marking, pages: Pages) -> None:
        self._marking, self._pages = marking, pages
        self._names = [point.name for point in marking.job.points]

    def routes(self) -> list[Route]:
        """The routes."""
        return [
            Route("/mark", self._page),
            Route("/api/mark", self._overview),
            Route("/api/mark/{number:int}", self._detail),
            Route("/photo/{number:int}", self._photo),
            Route("/api/mark/change", self._change, methods=["POST"]),
            Route("/api/mark/undo", self._undo, methods=["POST"]),
            Route("/api/mark/redo", self._redo, methods=["POST"]),
        ]

    def _page(self, _request: Request) -> Response:
        return self._pages.page("mark.html", {"name": self._pages.run.name})

    def _overview(self, _request: Request) -> Response:
        return JSONResponse(self._marking.overview())

    def _detail(self, request: Request) -> Response:
        number = request.path_params["number"]
        if number >= len(self._names):
            raise HTTPException(404)
        return JSONResponse(self._marking.detail(self._names[number]))

    def _photo(self, request: Request) -> Response:
        job, number = self._marking.job, request.path_params["number"]
        if number >= len(self._marking.photos):
            raise HTTPException(404)
        photo = job.photos[self._marking.photos[number]]
        tag = f'"{photo.sha256}"'
        headers = {"etag": tag, "cache-control": "private, no-cache"}
        if request.headers.get("if-none-match") == tag:
            return Response(status_code=304, headers=headers)
        data, kind = photo_for_browser(photo, job.photos_part, job.photos_dir)
        return Response(data, media_type=kind, headers=headers)

    def _change(self, request: Request) -> Response:
        body = _body(request)
        point, photo = _number(body, "point", len(self._names)), _number(body, "photo", len(self._marking.photos))
        after = _state(body)
        try:
            self._marking.change(
                self._names[point], self._marking.photos[photo], after, nudge=body.get("nudge") is True
            )
        except WrongRequestError as error:
            raise HTTPException(400, str(error)) from error
        return self._answer(point)

    def _undo(self, request: Request) -> Response:
        return self._answer_change(self._marking.undo(), request)

    def _redo(self, request: Request) -> Response:
        return self._answer_change(self._marking.redo(), request)

    def _answer_change(self, change: Change | None, _request: Request) -> Response:
        if change is None:
            return JSONResponse({"overview": self._marking.overview()})
        return self._answer(self._names.index(change.point), self._marking.photos.index(change.photo))

    def _answer(self, point: int, photo: int | None = None) -> Response:
        """Everything that a change affects; after undo or redo, ``photo`` is the photo to show."""
        overview, detail = self._marking.overview(), self._marking.detail(self._names[point])
        return JSONResponse({"overview": overview, "detail": detail, "point": point, "photo": photo})


def _body(request: Request) -> dict[str, Any]:
    """The JSON object in the request's body.

    Raises:
        HTTPException: if it is not a JSON object.
    """
    try:
        found = json.loads(request.scope["splatpipe.body"])
    except (ValueError, RecursionError) as error:
        raise HTTPException(400, "The request must be JSON.") from error
    if not isinstance(found, dict):
        raise HTTPException(400, "The request must be a JSON object.")
    return found


def _number(body: dict[str, Any], name: str, count: int) -> int:
    found = body.get(name)
    if type(found) is not int or not 0 <= found < count:
        raise HTTPException(400, f"The request must have a valid {name}.")
    return found


def _state(body: dict[str, Any]) -> State:
    action = body.get("action")
    if action not in ACTIONS:
        raise HTTPException(400, "The action must be mark, unmark or hide.")
    if action != "mark":
        return "hidden" if action == "hide" else None
    x, y = body.get("x"), body.get("y")
    if type(x) not in (int, float) or type(y) not in (int, float):
        raise HTTPException(400, "The request must have x and y.")
    try:
        return float(x), float(y)  # type: ignore[arg-type]
    except OverflowError as error:
        raise HTTPException(400, "The request must have x and y.") from error
