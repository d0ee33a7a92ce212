"""The calls of NodeODM's API, version 2.2.4, as its clients use them."""

from __future__ import annotations

import importlib.metadata
import json
from asyncio import CancelledError
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from typing import Any

from anyio import CancelScope, CapacityLimiter, to_thread
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Route

from splatpipe.pipeline.app.node.api.answers import DISK_FULL, SUCCESS, answer, error_answer, failure, option_errors
from splatpipe.pipeline.app.node.api.bodies import drain, drain_rest, limited, small_body
from splatpipe.pipeline.app.node.api.multipart import BadBodyError, Form, block_bytes, read_form
from splatpipe.pipeline.app.node.api.received import UploadedFile, refuse_files
from splatpipe.pipeline.app.node.assets.outputs import parse_outputs
from splatpipe.pipeline.app.node.assets.single import is_asset, media_type, open_asset
from splatpipe.pipeline.app.node.tasks.disk import free_bytes
from splatpipe.pipeline.app.node.tasks.names import BadNameError
from splatpipe.pipeline.app.node.tasks.node import NewTask, Node
from splatpipe.pipeline.app.node.tasks.options import LISTED, WrongOptionsError, parse_options
from splatpipe.pipeline.app.node.tasks.outgoing import OutgoingError
from splatpipe.pipeline.app.node.tasks.scheduler import RefusedTaskError
from splatpipe.pipeline.app.node.tasks.settings import MAX_FILES, MAX_TASK_BYTES
from splatpipe.pipeline.app.node.tasks.store import UnknownTaskError
from splatpipe.pipeline.app.node.tasks.uploads import ClosedUploadError, NameTakenError
from splatpipe.pipeline.app.serving.files import FileAnswer, FileNotServedError
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.machine import available_cores, available_memory_bytes, free_memory_bytes

API_VERSION = "2.2.4"
ENGINE = "splatpipe"
MAX_ENGINE_LETTERS = 32
MAX_INIT_BYTES = 8 << 20
MAX_IGNORED_BYTES = 1 << 20
REFUSALS = (RefusedTaskError, OutgoingError, BadBodyError, BadNameError, NameTakenError, SplatpipeError)
COMMANDS_AT_ONCE = 16  # cancellations and removals wait for the end of a run, and must not keep uploads from a thread


class Api:
    """The calls on a node.

    Args:
        node: The node.
    """

    def __init__(self, node: Node) -> None:
        self.node = node
        self._commands = CapacityLimiter(COMMANDS_AT_ONCE)
        self._receiving = 0  # bodies that are received now

    def routes(self) -> list[BaseRoute]:
        """The routes."""
        get, post = ["GET"], ["POST"]
        return [
            Route("/info", self.info, methods=get),
            Route("/options", self.options, methods=get),
            Route("/auth/info", self.auth_info, methods=get),
            Route("/auth/login", self.auth_none, methods=post),
            Route("/auth/register", self.auth_none, methods=post),
            Route("/task/list", self.task_list, methods=get),
            Route("/task/new", self.new, methods=post),
            Route("/task/new/init", self.init, methods=post),
            Route("/task/new/upload/{uuid}", self.upload, methods=post),
            Route("/task/new/commit/{uuid}", self.commit, methods=post),
            Route("/task/cancel", self.cancel, methods=post),
            Route("/task/remove", self.remove, methods=post),
            Route("/task/restart", self.restart, methods=post),
            Route("/task/{uuid}/info", self.task_info, methods=get),
            Route("/task/{uuid}/output", self.output, methods=get),
            Route("/task/{uuid}/download/{asset}", self.download, methods=get),
        ]

    async def info(self, _request: Request) -> Response:
        """What the node is and how busy."""
        queued, running = self.node.scheduler.counts()
        settings = self.node.settings
        return answer(
            {
                "version": API_VERSION,
                "taskQueueCount": queued + running,
                "totalMemory": available_memory_bytes(),
                "availableMemory": free_memory_bytes(),
                "cpuCores": available_cores(),
                "maxImages": MAX_FILES,
                "maxParallelTasks": settings.parallel,
                "engine": ENGINE,
                "engineVersion": importlib.metadata.version("splatpipe")[:MAX_ENGINE_LETTERS],
                "keepDays": settings.keep_days or None,
                "freeDisk": free_bytes(settings.folder),
                "leastFreeDisk": settings.least_free_bytes,
                "maxTaskBytes": MAX_TASK_BYTES,
            }
        )

    async def options(self, _request: Request) -> Response:
        """The options that tasks take."""
        return answer([option.as_json() for option in LISTED])

    async def auth_info(self, _request: Request) -> Response:
        """How to log in: not at all."""
        text = "Authentication is not required on this node, or is by a token that its owner gives."
        return answer({"message": text, "loginUrl": None, "registerUrl": None})

    async def auth_none(self, request: Request) -> Response:
        """Logging in, which this node does not know."""
        await drain(request, MAX_IGNORED_BYTES)
        return error_answer("This node has no accounts; use the token that its owner gives.")

    async def task_list(self, _request: Request) -> Response:
        """All tasks."""
        return answer([{"uuid": task.uuid} for task in self.node.tasks.all() if task.is_committed])

    async def init(self, request: Request) -> Response:
        """Begin a task."""
        if _has_form(request):
            form = await self._form(request, MAX_INIT_BYTES, refuse_files)
        else:
            form = Form({name: str(value) for name, value in (await small_body(request)).items()})
        wanted = await to_thread.run_sync(_new_task, form.fields, request.headers.get("set-uuid", ""))
        task = await to_thread.run_sync(self.node.create, wanted)
        return answer({"uuid": task.uuid})

    async def upload(self, request: Request) -> Response:
        """Receive files of a task."""
        uuid = _uuid(request)
        try:
            self.node.tasks.get(uuid)
            self._require_disk(request)
            form = await self._form(request, MAX_TASK_BYTES, self._opener(uuid))
        except (UnknownTaskError, ClosedUploadError):
            await drain_rest(request)
            return error_answer("Invalid uuid (not found)", no_retry=True)
        if not form.files:
            return error_answer("Need at least 1 file.", no_retry=True)
        return answer(SUCCESS)

    async def commit(self, request: Request) -> Response:
        """Close the upload of a task."""
        uuid = _uuid(request)
        await drain(request, MAX_IGNORED_BYTES)
        try:
            task = await to_thread.run_sync(self.node.commit, uuid)
        except UnknownTaskError:
            return error_answer("Invalid uuid (not found)")
        return answer({"uuid": task.uuid})

    async def new(self, request: Request) -> Response:
        """A whole task in one request."""
        set_uuid = request.headers.get("set-uuid", "")
        self._require_disk(request)
        task = await to_thread.run_sync(self.node.create, NewTask(uuid=set_uuid))
        try:
            if _has_form(request):
                form = await self._form(request, MAX_TASK_BYTES, self._checking_opener(task.uuid))
            else:
                form = Form({name: str(value) for name, value in (await small_body(request)).items()})
            wanted = await to_thread.run_sync(_new_task, form.fields, "")
            await to_thread.run_sync(self.node.amend, task.uuid, wanted)
            await to_thread.run_sync(self.node.commit, task.uuid)
        except (Exception, CancelledError):
            with CancelScope(shield=True), suppress(UnknownTaskError, OSError):
                await to_thread.run_sync(self.node.give_up, task.uuid)
            raise
        return answer({"uuid": task.uuid})

    async def task_info(self, request: Request) -> Response:
        """The state of a task."""
        uuid = _uuid(request)
        try:
            task = self.node.committed(uuid)
            found = self.node.info(task)
        except UnknownTaskError:
            return error_answer(f"{shown(uuid)} not found")
        line = request.query_params.get("with_output")
        if line is not None:
            found["output"] = await to_thread.run_sync(self.node.lines, task, _number(line))
        return answer(found)

    async def output(self, request: Request) -> Response:
        """The log of a task."""
        uuid = _uuid(request)
        try:
            task = self.node.committed(uuid)
        except UnknownTaskError:
            return error_answer(f"{shown(uuid)} not found")
        line = _number(request.query_params.get("line", "0"))
        return answer(await to_thread.run_sync(self.node.lines, task, line))

    async def download(self, request: Request) -> Response:
        """A file of a task's results."""
        uuid, name = _uuid(request), request.path_params["asset"]
        if not is_asset(name):
            return error_answer("Invalid asset")
        try:
            folder = self.node.results(uuid)
            if folder is None:
                return error_answer("Asset not ready")
            file = await to_thread.run_sync(open_asset, folder, name)
        except UnknownTaskError:
            return error_answer(f"{shown(uuid)} not found")
        except FileNotServedError:
            return error_answer("Invalid asset")
        return FileAnswer(file, media_type(name), {"content-disposition": f'attachment; filename="{name}"'})

    async def cancel(self, request: Request) -> Response:
        """Cancel a task."""
        return await self._command(request, lambda uuid, _body: self.node.scheduler.cancel(uuid))

    async def remove(self, request: Request) -> Response:
        """Remove a task."""
        return await self._command(request, lambda uuid, _body: self.node.scheduler.remove(uuid))

    async def restart(self, request: Request) -> Response:
        """Run a task again."""

        def restart(uuid: str, body: Mapping[str, Any]) -> object:
            options = body.get("options")
            if options is None or options == "":
                return self.node.restart(uuid, None)
            given = parse_options(options if isinstance(options, str) else _as_text(options))
            return self.node.restart(uuid, given)

        return await self._command(request, restart)

    async def _command(self, request: Request, do: Any) -> Response:
        body = await small_body(request)
        uuid = body.get("uuid")
        if not isinstance(uuid, str) or not uuid:
            return failure("uuid param missing.")
        uuid = uuid.lower()
        try:
            self.node.committed(uuid)
            await to_thread.run_sync(do, uuid, body, limiter=self._commands)
        except UnknownTaskError:
            return failure(f"{shown(uuid)} not found")
        except (RefusedTaskError, WrongOptionsError) as error:
            return failure(_said(error))
        except OSError:
            return failure(DISK_FULL)
        return answer(SUCCESS)

    def _opener(self, uuid: str) -> partial[UploadedFile]:
        return partial(UploadedFile.begin, self.node, uuid)

    def _checking_opener(self, uuid: str) -> Callable[[str, Mapping[str, str]], UploadedFile]:
        """As ``_opener``; what the fields before the first file ask for is checked before that is received."""
        begin, checked = self._opener(uuid), False

        def open_file(name: str, fields: Mapping[str, str]) -> UploadedFile:
            nonlocal checked
            if not checked:
                _new_task(fields, "")
                checked = True
            return begin(name, fields)

        return open_file

    def _require_disk(self, request: Request) -> None:
        """Refuse a body for which there is no disk before it is sent; one of unknown length is seen as it comes."""
        length = request.headers.get("content-length", "")
        if length.isascii() and length.isdecimal() and len(length) < 20:
            self.node.reserve(int(length))

    async def _form(self, request: Request, max_bytes: int, open_file: Any) -> Form:
        body = limited(request, max_bytes)
        kind = request.headers.get("content-type", "")
        self._receiving += 1
        try:
            return await read_form(kind, body, open_file, to_thread.run_sync, block_bytes(self._receiving))
        finally:
            self._receiving -= 1


def make_app(api: Api, further: list[BaseRoute]) -> Starlette:
    """The application, without its guard.

    Args:
        api: The API's calls.
        further: Routes of the page.
    """
    handlers: dict[Any, Any] = {HTTPException: _no_route, OSError: _disk_trouble, WrongOptionsError: _refused}
    handlers |= dict.fromkeys(REFUSALS, _refused)
    app = Starlette(routes=[*api.routes(), *further], exception_handlers=handlers)
    app.router.redirect_slashes = False
    return app


def _no_route(_request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    return JSONResponse({"error": error.detail}, error.status_code)


async def _disk_trouble(request: Request, _error: Exception) -> Response:
    await drain_rest(request)
    return error_answer(DISK_FULL)


async def _refused(request: Request, error: Exception) -> Response:
    await drain_rest(request)
    return error_answer(_said(error))


def _said(error: Exception) -> str:
    if isinstance(error, SplatpipeError):
        return f"{error.message} {error.hint}".strip()
    return option_errors(error.errors) if isinstance(error, WrongOptionsError) else str(error)


def shown(text: str) -> str:
    """A text of a client's as part of an answer."""
    return "".join(letter if letter.isprintable() else "?" for letter in text[:60])


def _has_form(request: Request) -> bool:
    return request.headers.get("content-type", "").lower().startswith("multipart/")


def _uuid(request: Request) -> str:
    return str(request.path_params["uuid"]).lower()


def _number(text: str) -> int:
    try:
        return max(-(10**9), min(10**9, int(text))) if len(text) < 12 else 0
    except ValueError:
        return 0


def _as_text(value: Any) -> str:
    return json.dumps(value)


def _new_task(fields: Mapping[str, str], uuid: str) -> NewTask:
    """What a client asks for with the fields of a form.

    Raises:
        UsageError: if outputs are wrong.
        WrongOptionsError: if options have wrong values.
    """
    created = fields.get("dateCreated", "")
    return NewTask(
        fields.get("name", ""),
        parse_options(fields.get("options")),
        fields.get("webhook", ""),
        fields.get("zipurl", ""),
        parse_outputs(fields.get("outputs", "")),
        int(created) if created.isascii() and created.isdecimal() and len(created) < 15 else 0,
        uuid,
    )
