"""Connections of the node: many, each waited for only so long, and bodies only as long as they move.

Uploads take hours on a slow line, so that a body has no time limit, but a least speed: what arrives in each period is
counted while the node is ready to read. A client that is refused a connection tries again; an answer with a status of
503 would end its task.
"""

from __future__ import annotations

import asyncio

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from splatpipe.pipeline.app.serving.connection import longest_waiting

HEAD_S = 20.0  # for a request's head; also how long an idle connection is kept
PERIOD_S = 30.0
LEAST_BYTES = 8 << 10  # of a body in each period: a line of 3 kbit/s
UNREAD_PERIODS = 10  # without a byte of the answer being read
MAX_CONNECTIONS = 512  # 30 clients with ten threads, and room for polls


class NodeConnection(H11Protocol):
    """An HTTP connection of the node."""

    _timer: asyncio.TimerHandle | None = None
    _period_bytes = 0
    _unread = 0  # bytes of the answer that wait for the client
    _unread_periods = 0
    since_s = 0.0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait for a request; if there are too many connections, an idle one makes room, or this one goes."""
        super().connection_made(transport)
        self.since_s = self.loop.time()
        self._watch()
        if len(self.connections) > MAX_CONNECTIONS:
            waiting = [each for each in self.connections if isinstance(each, NodeConnection) and each.is_waiting]
            longest_waiting(waiting or [self]).transport.close()

    def data_received(self, data: bytes) -> None:
        """Process what the client sent."""
        self._period_bytes += len(data)
        super().data_received(data)

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        super().on_response_complete()
        self.since_s = self.loop.time()
        self._watch()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop waiting."""
        if self._timer is not None:
            self._timer.cancel()
        super().connection_lost(exc)

    @property
    def is_waiting(self) -> bool:
        """Whether a request's head is awaited."""
        return self.conn.their_state is h11.IDLE and not self.transport.is_closing()

    @property
    def peer(self) -> str:
        """The client's address."""
        return self.client[0] if self.client else ""

    def _watch(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._period_bytes = 0
        self._timer = self.loop.call_later(HEAD_S, self._check)

    def _check(self) -> None:
        """Close a connection that does not move; called at the end of each period."""
        state = self.conn.their_state
        unread = self.transport.get_write_buffer_size() if self.flow.write_paused else 0
        self._unread_periods = self._unread_periods + 1 if unread and unread == self._unread else 0
        stuck = state is h11.IDLE or self._unread_periods >= UNREAD_PERIODS
        if state is h11.SEND_BODY and not self.flow.read_paused:
            stuck = self._period_bytes < LEAST_BYTES
        if stuck:
            self.transport.abort()
            return
        self._period_bytes, self._unread = 0, unread
        self._timer = self.loop.call_later(PERIOD_S, self._check)
