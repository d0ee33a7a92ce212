"""Answers in the form that clients of NodeODM take: errors are JSON with status 200, and only routes are not found."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from starlette.responses import JSONResponse, Response

BAD_TOKEN = "Invalid authentication token: token does not match."
DISK_FULL = "The node's disk is full: nothing was lost, try again later, or let its owner make room."


def answer(value: Any) -> Response:
    """A value as JSON."""
    return JSONResponse(value)


def error_answer(text: str, *, no_retry: bool = False) -> Response:
    """An error in the words of NodeODM.

    Args:
        text: The error.
        no_retry: Tell clients that sending the same again is of no use.
    """
    return JSONResponse({"error": text, **({"noRetry": True} if no_retry else {})})


def failure(text: str) -> Response:
    """The error of a command on a task."""
    return JSONResponse({"success": False, "error": text})


SUCCESS = {"success": True}


def option_errors(errors: Sequence[tuple[str, str]]) -> str:
    """Wrong options as the JSON text that clients expect in ``error``."""
    return json.dumps([{"name": name, "error": text} for name, text in errors])
