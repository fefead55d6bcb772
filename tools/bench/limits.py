"""Limits the connections and half-sent requests that one client may hold.

A connection costs a place from its first byte on, and half a request is no request: uvicorn waits for the rest for
ever and counts it against everybody. Here a head has ``HEAD_S``, and only so many connections may be without a request
in progress; the oldest of the client that has most of them gives way to a new one. Complete requests never do.
"""

from __future__ import annotations

import asyncio

from uvicorn.protocols.http.h11_impl import H11Protocol

HEAD_S = 5.0
"""Time for the head of a request, from the connection or from its first byte on a connection that is kept open."""

MAX_WAITING = 64
"""Connections without a request in progress, of all clients together."""

_LATE = b"HTTP/1.1 408 Request Timeout\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"


class BoundedHttp(H11Protocol):
    """HTTP/1.1 of uvicorn with a limit in time and number for what is not yet a request."""

    _head_timer: asyncio.TimerHandle | None = None

    @property
    def waits(self) -> bool:
        """True while no request is in progress on this connection."""
        return self.cycle is None or self.cycle.response_complete

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self.began_s = self.loop.time()
        self._start_timer()
        self._make_room()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if not self.waits or self not in self.connections:  # the head is complete; or a websocket took over
            self._stop_timer()
        elif self._head_timer is None:
            self._start_timer()

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_timer()
        super().connection_lost(exc)

    def _start_timer(self) -> None:
        self._head_timer = self.loop.call_later(HEAD_S, self._give_up)

    def _stop_timer(self) -> None:
        if self._head_timer is not None:
            self._head_timer.cancel()
            self._head_timer = None

    def _give_up(self) -> None:
        if not self.transport.is_closing():
            self.transport.write(_LATE)
            self.transport.close()

    def _make_room(self) -> None:
        """Close waiting connections until at most ``MAX_WAITING`` are left."""
        waiting = [
            c for c in self.connections if isinstance(c, BoundedHttp) and c.waits and not c.transport.is_closing()
        ]
        while len(waiting) > MAX_WAITING:
            clients = [c.client[0] if c.client else "" for c in waiting]
            greediest = max(set(clients), key=clients.count)
            victim = min((c for c, client in zip(waiting, clients, strict=True) if client == greediest), key=_age)
            waiting.remove(victim)
            victim.transport.abort()


def _age(connection: BoundedHttp) -> float:
    return connection.began_s
