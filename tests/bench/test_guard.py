"""Who is let in: host, origin, token, size. The layer alone, without a server."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from tools.bench.guard import MAX_BODY_BYTES, MAX_OF_CLIENT, MAX_REQUESTS, Access, Guard

LOCAL = Access("right", frozenset({"127.0.0.1:8750", "localhost:8750"}), open_reading=True)
REMOTE = Access("right", frozenset({"lab:8750"}), open_reading=False)


def ask(
    access: Access,
    method: str,
    path: str,
    headers: dict[str, str],
    body: tuple[bytes, ...] = (b"",),
    kind: str = "http",
) -> int:
    """Status of the answer (of the close, for a websocket); 200 when the request came through."""
    sent: list[dict[str, Any]] = []
    parts = list(body)

    async def application(scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] == "websocket":
            await send({"type": "websocket.accept"})
            return
        while (await receive())["more_body"]:
            pass
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b""})

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": parts.pop(0), "more_body": bool(parts)}

    async def send(message: dict[str, Any]) -> None:
        sent.append(message)

    raw = [(k.encode(), v.encode()) for k, v in headers.items()]
    scope = {"type": kind, "method": method, "path": path, "headers": raw}
    asyncio.run(Guard(application, access)(scope, receive, send))  # pyright: ignore[reportArgumentType]
    return sent[0].get("status", sent[0].get("code", 200))


HOST = {"host": "127.0.0.1:8750"}


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 403),
        ({"x-micron-token": "wrong"}, 403),
        ({"x-micron-token": "right"}, 200),
        ({"x-micron-token": "right", "origin": "http://127.0.0.1:8750"}, 200),
        ({"x-micron-token": "right", "origin": "http://evil.example"}, 403),
        ({"x-micron-token": "right", "origin": "null"}, 403),
        ({"x-micron-token": "right", "content-length": str(10 << 20)}, 413),
        ({"x-micron-token": "right", "content-length": "many"}, 413),
    ],
)
def test_changing_something_needs_token_and_same_origin(headers: dict[str, str], status: int):
    assert ask(LOCAL, "POST", "/api/safe", {**HOST, **headers}) == status


def test_looking_is_free_on_loopback_and_needs_the_token_elsewhere():
    assert ask(LOCAL, "GET", "/api/channels", HOST) == 200
    assert ask(REMOTE, "GET", "/api/channels", {"host": "lab:8750"}) == 403
    assert ask(REMOTE, "GET", "/api/channels", {"host": "lab:8750", "x-micron-token": "right"}) == 200
    assert ask(REMOTE, "GET", "/static/main.js", {"host": "lab:8750"}) == 200


def test_a_name_that_somebody_pointed_at_us_is_refused():
    assert ask(LOCAL, "GET", "/", {"host": "rebound.example:8750"}) == 421
    assert ask(LOCAL, "GET", "/", {}) == 421


def test_a_websocket_of_another_page_is_refused():
    assert ask(LOCAL, "GET", "/live", {**HOST, "origin": "http://evil.example"}, kind="websocket") == 4403
    assert ask(LOCAL, "GET", "/live", {**HOST, "origin": "http://127.0.0.1:8750"}, kind="websocket") == 200


class Crowd:
    """Requests that the application holds until ``leave``."""

    def __init__(self, access: Access) -> None:
        self.leave = asyncio.Event()
        self.guard = Guard(self._application, access)  # pyright: ignore[reportArgumentType]

    async def _application(self, scope: Any, receive: Any, send: Any) -> None:
        await self.leave.wait()
        await send({"type": "http.response.start", "status": 200, "headers": []})

    async def ask(self, client: str, headers: dict[str, str]) -> int:
        sent: list[dict[str, Any]] = []

        async def receive() -> dict[str, Any]:
            return {"type": "http.request", "body": b"", "more_body": False}

        async def send(message: dict[str, Any]) -> None:
            sent.append(message)

        raw = [(k.encode(), v.encode()) for k, v in headers.items()]
        scope = {"type": "http", "method": "GET", "path": "/", "headers": raw, "client": (client, 1)}
        await self.guard(scope, receive, send)  # pyright: ignore[reportArgumentType]
        return sent[0]["status"]


def test_who_has_the_token_finds_a_place_however_many_others_there_are():
    async def run() -> None:
        crowd = Crowd(LOCAL)
        first = [asyncio.create_task(crowd.ask("a", HOST)) for _ in range(MAX_OF_CLIENT)]
        await asyncio.sleep(0)
        assert await crowd.ask("a", HOST) == 503
        others = [asyncio.create_task(crowd.ask("b", HOST)) for _ in range(MAX_REQUESTS - MAX_OF_CLIENT)]
        await asyncio.sleep(0)
        assert await crowd.ask("c", HOST) == 503
        entitled = [
            asyncio.create_task(crowd.ask("a", {**HOST, "x-micron-token": "right"})) for _ in range(2 * MAX_REQUESTS)
        ]
        await asyncio.sleep(0)
        crowd.leave.set()
        assert set(await asyncio.gather(*first, *others, *entitled)) == {200}
        assert await crowd.ask("c", HOST) == 200, "places come back"

    asyncio.run(run())


def test_a_long_body_without_a_length_is_cut_off():
    parts = (b"x" * 40_000,) * 3
    assert MAX_BODY_BYTES < 3 * 40_000
    assert ask(LOCAL, "POST", "/api/safe", {**HOST, "x-micron-token": "right"}, parts) == 413
