"""The routes of the node's page."""

from __future__ import annotations

from starlette.routing import BaseRoute

from splatpipe.pipeline.app.node.tasks.node import Node

OPEN_PATHS: tuple[str, ...] = ()  # beginnings of paths whose requests this room checks itself
ESCAPED_PATHS: tuple[bytes, ...] = ()  # beginnings of paths that may have escapes


def page_routes(_node: Node) -> list[BaseRoute]:
    """The routes, beside those of the API."""
    return []
