"""What half a request, a slow one or a long one takes from others: nothing. Sockets on loopback, no firmware."""

from __future__ import annotations

import contextlib
import json
import socket
from pathlib import Path

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from tests.bench.still import TOKEN, Still, made_up_rows, still_server
from tools.bench import guard, limits
from tools.bench.app import MAX_VIEWERS, RESERVED_VIEWERS
from tools.bench.guard import MAX_BODY_BYTES
from tools.bench.wire import HEADER

PATIENCE_S = 60.0


@pytest.fixture
def still(still: Still) -> Still:
    still.session.orders.clear()
    return still


def opened(still: Still, first: bytes = b"") -> socket.socket:
    sock = socket.create_connection(still.place, timeout=PATIENCE_S)
    sock.sendall(first)
    return sock


def head(still: Still, line: str, *more: str) -> bytes:
    host = f"Host: {still.place[0]}:{still.place[1]}"
    return "\r\n".join((f"{line} HTTP/1.1", host, *more, "", "")).encode()


def status(sock: socket.socket) -> int:
    """Status of the answer on ``sock``; 0 when the server closed without one."""
    said = b""
    while b"\r\n" not in said:
        try:
            part = sock.recv(4096)
        except ConnectionResetError:
            return 0
        if not part:
            return 0
        said += part
    return int(said.split()[1])


@pytest.mark.parametrize("number", [70, 300])
@pytest.mark.parametrize("first", [b"", b"POST /api/safe HTTP/1.1\r\nHost: 127.0.0.1"])
def test_half_requests_take_no_answer_away(still: Still, number: int, first: bytes):
    with contextlib.ExitStack() as stack:
        for _ in range(number):
            stack.enter_context(opened(still, first))
        order = stack.enter_context(opened(still, head(still, "POST /api/safe", f"X-Micron-Token: {TOKEN}")))
        assert status(order) == 200
        assert status(stack.enter_context(opened(still, head(still, "GET /api/channels")))) == 200
    assert still.session.orders == ["safe"]


def test_a_head_that_does_not_end_is_answered_and_closed(still: Still, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(limits, "HEAD_S", 0.05)
    with opened(still, b"GET / HTTP/1.1\r\n") as sock:
        assert status(sock) == 408
        assert sock.recv(4096) == b""
    with opened(still, head(still, "GET /api/channels")) as sock:  # also after a whole request
        assert status(sock) == 200
        sock.sendall(b"GET /ap")
        with contextlib.suppress(ConnectionResetError):
            while sock.recv(1 << 16):
                pass


def test_a_body_that_does_not_end_is_answered_and_closed(still: Still, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(guard, "BODY_S", 0.05)
    with opened(still, head(still, "POST /api/safe", f"X-Micron-Token: {TOKEN}", "Content-Length: 10") + b"{") as sock:
        assert status(sock) == 408
    assert still.session.orders == []


def test_a_body_in_chunks_that_is_too_long_is_refused(still: Still):
    start = head(still, "POST /api/recording/start", f"X-Micron-Token: {TOKEN}", "Transfer-Encoding: chunked")
    chunk = b"4000\r\n" + b" " * 0x4000 + b"\r\n"
    with opened(still, start) as sock:
        for _ in range(MAX_BODY_BYTES // 0x4000 + 1):
            sock.sendall(chunk)
        assert status(sock) == 413


def test_a_body_in_chunks_that_fits_is_read(still: Still):
    start = head(still, "POST /api/safe", f"X-Micron-Token: {TOKEN}", "Transfer-Encoding: chunked")
    with opened(still, start + b"1\r\n{\r\n1\r\n}\r\n0\r\n\r\n") as sock:
        assert status(sock) == 200


def test_a_page_with_the_token_is_let_in_where_all_free_places_are_taken(still: Still):
    live = still.base.replace("http", "ws") + "/live"

    def viewer() -> ClientConnection:
        # who does not read cannot hear the other end's goodbye either: it is not waited for
        return connect(live, open_timeout=PATIENCE_S, close_timeout=0.1)

    with contextlib.ExitStack() as stack:
        for _ in range(MAX_VIEWERS):
            stack.enter_context(viewer()).recv(PATIENCE_S)
        with viewer() as operator:
            operator.send(json.dumps({"type": "hello", "token": TOKEN}))
            assert json.loads(operator.recv(PATIENCE_S))["may_order"] is True
        more = [stack.enter_context(viewer()) for _ in range(RESERVED_VIEWERS)]
        with pytest.raises(ConnectionClosed):
            more[0].recv(PATIENCE_S)  # no token: sees nothing, and is closed


@pytest.mark.parametrize("action", ["look", "file"])
def test_a_link_in_the_recordings_folder_leads_nowhere(still: Still, tmp_path: Path, action: str):
    secret = tmp_path / "secret.mcap"
    secret.write_text("not for everybody")
    link = still.session.recorder.folder / "elsewhere.mcap"
    link.unlink(missing_ok=True)
    link.symlink_to(secret)
    with opened(still, head(still, f"GET /api/recordings/elsewhere/{action}")) as sock:
        assert status(sock) == 400
    with opened(still, head(still, "GET /api/recordings", "Connection: close")) as sock:
        said = b"".join(iter(lambda: sock.recv(1 << 16), b""))
    assert b"first hand" in said
    assert b"elsewhere" not in said
    with opened(still, head(still, "GET /api/mismatch", "Connection: close")) as sock:
        assert b"elsewhere" not in b"".join(iter(lambda: sock.recv(1 << 16), b""))


@pytest.mark.parametrize("path", ["/api/recordings", "/api/recordings/first%20hand/file", "/api/recordings/x/look"])
def test_behind_listen_recordings_need_the_token(tmp_path: Path, path: str):
    with still_server(tmp_path / "recordings", open_reading=False) as still:
        with opened(still, head(still, f"GET {path}")) as sock:
            assert status(sock) == 403
        with opened(still, head(still, f"GET {path}", f"X-Micron-Token: {TOKEN}")) as sock:
            assert status(sock) in (200, 400)  # 400: there is none of that name


def test_what_a_viewer_has_is_not_sent_again(still: Still):
    """Also a bucket that is not full yet, as the last one of a run that has ended: only with further rows."""
    ask = {"type": "subscribe", "id": 1, "channels": ["volts_0"], "rows": 60_000, "pixels": 900}
    with connect(still.base.replace("http", "ws") + "/live", open_timeout=PATIENCE_S) as viewer:
        viewer.send(json.dumps(ask))

        def frames(states: int) -> list[bytes]:
            """What comes until so many status messages have come, ten a second."""
            found: list[bytes] = []
            while states:
                message = viewer.recv(PATIENCE_S)
                if isinstance(message, bytes):
                    found.append(message)
                else:
                    states -= json.loads(message)["type"] == "state"
            return found

        (whole,) = frames(5)
        still.session.history.append(made_up_rows()[:5])
        (further,) = frames(5)
    (_, _, _, n, per_bucket, _, first), (_, _, _, n_more, _, _, first_more) = map(HEADER.unpack_from, (whole, further))
    assert (n, per_bucket, first) == (188, 64, 0.0)
    assert (n_more, first_more) == (1, 187.0)
