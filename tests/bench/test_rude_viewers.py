"""Viewers that misbehave cost the firmware nothing and the server little."""

from __future__ import annotations

import json
import socket
from typing import Any
from urllib.parse import urlparse

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from tests.bench.conftest import Server

pytestmark = pytest.mark.timeout(400)

GROWTH_BYTES = 64 << 20
ALL = {"type": "subscribe", "id": 1, "channels": [f"volts_{i}" for i in range(8)], "rows": 600_000, "pixels": 4000}


def next_binary(ws: Any) -> bytes:
    while True:
        message = ws.recv(30)
        if isinstance(message, bytes):
            return message


def send_and_listen(ws: Any, messages: list[str | bytes]) -> None:
    """Send everything, then read until the other end closes."""
    for message in messages:
        ws.send(message)
    while True:
        ws.recv(30)


def test_two_viewers_see_the_same(server: Server):
    server.wait_running()
    with connect(server.live) as one, connect(server.live) as two:
        for ws in (one, two):
            ws.send(json.dumps({**ALL, "rows": 1000, "pixels": 1000}))
        assert len(next_binary(one)) > 1000
        assert len(next_binary(two)) > 1000


def test_a_viewer_that_stops_reading_delays_nobody_and_fills_no_memory(server: Server):
    server.wait_running()
    before = server.memory_bytes()
    address = urlparse(server.base)
    with socket.create_connection((str(address.hostname), int(address.port or 0))) as deaf:
        # a websocket by hand, since a library would read in the background
        deaf.sendall(
            f"GET /live HTTP/1.1\r\nHost: {address.netloc}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\n\r\n".encode()
        )
        assert deaf.recv(4096).startswith(b"HTTP/1.1 101")
        data = json.dumps(ALL).encode()
        deaf.sendall(bytes([0x81, 0xFE]) + len(data).to_bytes(2, "big") + bytes(4) + data)
        first = server.wait_for(lambda s: True, "state")
        later = server.wait_for(lambda s: s["rows"] > first["rows"] + 5000, "five more seconds")
        assert later["phase"] == "running"
        with connect(server.live) as ws:
            ws.send(json.dumps(ALL))
            assert next_binary(ws)
        assert server.memory_bytes() - before < GROWTH_BYTES


def test_a_thousand_senseless_messages_end_that_connection_and_nothing_else(server: Server):
    rows = server.wait_running()["rows"]
    nonsense = [
        "", "null", "[]", "{", '{"type": 7}', '{"type": "order", "order": "safe"}', "\u2028" * 50, "[" * 5000,
        '{"type": "subscribe", "id": -1}', '{"type": "subscribe", "id": 1, "channels": ["volts_0"], "rows": 1e99}',
        '{"type": "range", "id": 1, "channels": ["nothing"], "first": 0, "stop": 1, "pixels": 0}',
        '{"type": "hello", "token": "wrong"}', '{"type": "pointer", "psi": NaN}',
    ]  # fmt: skip
    messages = [nonsense[i % len(nonsense)] if i % 3 else bytes([i % 256]) * 100 for i in range(1000)]
    with connect(server.live) as ws, pytest.raises(ConnectionClosed) as closed:
        send_and_listen(ws, messages)
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 1008
    assert server.wait_for(lambda s: s["rows"] > rows, "more rows")["phase"] == "running"


def test_a_request_of_ten_megabytes_is_refused_unread(server: Server):
    server.wait_running()
    before = server.memory_bytes()
    address = urlparse(server.base)
    with socket.create_connection((str(address.hostname), int(address.port or 0)), timeout=30) as sock:
        sock.sendall(
            f"POST /api/safe HTTP/1.1\r\nHost: {address.netloc}\r\nX-Micron-Token: {server.token}\r\n"
            f"Content-Length: {10 << 20}\r\n\r\n".encode()
        )
        assert sock.recv(4096).startswith(b"HTTP/1.1 413")
    with connect(server.live) as ws, pytest.raises(ConnectionClosed):
        send_and_listen(ws, ["x" * (10 << 20)])
    assert server.memory_bytes() - before < GROWTH_BYTES
    assert server.state()["phase"] == "running"


@pytest.mark.parametrize("path", ["/api/safe", "/api/firmware/stop", "/api/recording/start", "/api/calibrate/apply"])
def test_a_wrong_token_changes_nothing(server: Server, path: str):
    server.wait_running()
    for token in ("wrong", None):
        assert server.request("POST", path, b"{}", token)[0] == 403
    assert server.state()["phase"] == "running"


def test_bad_requests_are_one_clear_line(server: Server):
    for path, body in (
        ("/api/recording/start", b'{"name": "../../etc/passwd"}'),
        ("/api/recording/note", b"[]"),
        ("/api/compare", b'{"method": "magic"}'),
        ("/api/filters/use", b'{"method": "magic"}'),
        ("/api/mismatch/apply", b"{}"),
        ("/api/mismatch/start", b'{"recording": "none"}'),
        ("/api/calibrate/poses", b'{"means_V": [[1, 2]]}'),
        ("/api/firmware/start", b'{"bench": "/etc/passwd"}'),
        ("/api/targets/start", b'{"mapping": "thought"}'),
        ("/api/recordings/nothing/delete", b"{}"),
    ):
        code, answer = server.request("POST", path, body)
        assert code == 400, path
        assert answer["error"]
        assert "\n" not in answer["error"]
