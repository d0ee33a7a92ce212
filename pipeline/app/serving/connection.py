"""Connections that are waited for only so long: half a request holds no place.

Anybody who reaches the port may open connections and send nothing, or a byte now and then. Who has a cookie is known
only once a request is complete, so until then a connection is cheap to lose: it has some seconds, and there are few.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from typing import Protocol, TypeVar

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

REQUEST_S = 10.0  # for a request's head, and again for its body, which is at most 16 KiB
MAX_WAITING = 32  # connections without a complete head: browsers keep six, some of them in advance


class Connection(H11Protocol):
    """An HTTP connection whose client must send a whole request in time."""

    _timer: asyncio.TimerHandle | None = None
    _awaited: object = None  # h11's state of the client: a head is awaited in IDLE, a body in SEND_BODY
    _since_s = 0.0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait, in the place of another connection if there are too many."""
        super().connection_made(transport)
        self._follow()
        waiting = [other for other in self.connections if isinstance(other, Connection) and other.is_waiting]
        if len(waiting) > MAX_WAITING:
            longest_waiting(waiting).transport.close()

    def data_received(self, data: bytes) -> None:
        """Process what the client sent."""
        super().data_received(data)
        self._follow()

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        super().on_response_complete()
        self._follow()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop waiting."""
        self._stop()
        super().connection_lost(exc)

    @property
    def is_waiting(self) -> bool:
        """Whether a request's head is awaited."""
        return self._awaited is h11.IDLE and not self.transport.is_closing()

    @property
    def peer(self) -> str:
        """The client's address."""
        return self.client[0] if self.client else ""

    @property
    def since_s(self) -> float:
        """When it began to wait, on the event loop's clock."""
        return self._since_s

    def _follow(self) -> None:
        """Set the timer when a head or a body begins to be awaited; what arrives of it does not set it again."""
        state = self.conn.their_state
        if state not in (h11.IDLE, h11.SEND_BODY):
            self._stop()
        elif state is not self._awaited:
            self._stop()
            self._awaited, self._since_s = state, self.loop.time()
            self._timer = self.loop.call_later(REQUEST_S, self.transport.close)

    def _stop(self) -> None:
        self._awaited = None
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


class Waiting(Protocol):
    """A connection that waits for a request."""

    @property
    def peer(self) -> str:
        """The client's address."""

    @property
    def since_s(self) -> float:
        """When it began to wait."""


Kind = TypeVar("Kind", bound=Waiting)


def longest_waiting(waiting: list[Kind]) -> Kind:
    """The connection to close: of the address that has most of them, the one that has waited longest."""
    crowd = Counter(connection.peer for connection in waiting).most_common(1)[0][0]
    return min((connection for connection in waiting if connection.peer == crowd), key=lambda each: each.since_s)
