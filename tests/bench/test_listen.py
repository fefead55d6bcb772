"""``--listen``: who may look and order when the page is not on loopback. In process: no firmware, no socket."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import DEFAULT_BENCH
from tools.bench import viewer
from tools.bench.app import make_app
from tools.bench.firmware import Choice
from tools.bench.guard import Access
from tools.bench.serve import access_for, bind
from tools.bench.session import Session
from tools.errors import InputError

Message = dict[str, Any]


def talk(
    access: Access, host: str, says: list[Message], enough: Callable[[list[Message]], bool], folder: Path
) -> list[Message]:
    """Everything that the server sends to a websocket that says ``says``, until ``enough``."""
    heard: list[Message] = []

    async def run() -> None:
        session = Session(Choice(DEFAULT_BENCH), folder)
        pump = asyncio.create_task(session.run_forever())
        app = make_app(session, access)
        done = asyncio.Event()
        incoming = [{"type": "websocket.connect"}]
        incoming += [{"type": "websocket.receive", "text": json.dumps(message)} for message in says]

        async def receive() -> Message:
            if incoming:
                return incoming.pop(0)
            await done.wait()
            return {"type": "websocket.disconnect", "code": 1000}

        async def send(message: Message) -> None:
            heard.append(message)
            if message["type"] == "websocket.close" or enough(heard):
                done.set()

        scope = {"type": "websocket", "path": "/live", "headers": [(b"host", host.encode())], "query_string": b""}
        await asyncio.wait_for(app({**scope, "subprotocols": []}, receive, send), 60)  # pyright: ignore[reportArgumentType]
        pump.cancel()

    asyncio.run(run())
    return heard


def has_state(heard: list[Message]) -> bool:
    return any(json.loads(m["text"])["type"] == "state" for m in heard if m.get("text"))


@pytest.mark.parametrize("says", [[], [{"type": "hello", "token": "wrong"}], [{"type": "hello", "token": 7}]])
def test_behind_listen_a_websocket_without_the_token_sees_nothing(
    says: list[Message], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(viewer, "HELLO_S", 0.05)
    remote = access_for("192.0.2.7", 8750, "right")
    heard = talk(remote, "192.0.2.7:8750", says, has_state, tmp_path)
    assert not has_state(heard)
    assert heard[-1]["type"] == "websocket.close"
    assert heard[-1]["code"] == 4403


def test_behind_listen_the_token_opens_it(tmp_path: Path):
    remote = access_for("192.0.2.7", 8750, "right")
    heard = talk(remote, "192.0.2.7:8750", [{"type": "hello", "token": "right"}], has_state, tmp_path)
    state = next(json.loads(m["text"]) for m in heard if m.get("text") and '"state"' in m["text"])
    assert state["may_order"] is True
    assert "right" not in json.dumps({k: v for k, v in state.items() if k != "may_order"})


def test_on_loopback_anybody_may_look_and_nobody_order(tmp_path: Path):
    heard = talk(access_for("127.0.0.1", 8750, "right"), "127.0.0.1:8750", [], has_state, tmp_path)
    states = [json.loads(m["text"]) for m in heard if m.get("text") and '"state"' in m["text"]]
    assert states
    assert not any(state["may_order"] for state in states)


@pytest.mark.parametrize(
    ("address", "hosts", "looks"),
    [
        ("127.0.0.1", {"127.0.0.1:8750", "localhost:8750"}, True),
        ("::1", {"[::1]:8750", "127.0.0.1:8750", "localhost:8750"}, True),
        ("192.0.2.7", {"192.0.2.7:8750", "lab:8750"}, False),
    ],
)
def test_host_names_that_are_answered(address: str, hosts: set[str], looks: bool):
    access = access_for(address, 8750, "t", () if looks else ("LAB",))
    assert access.hosts == hosts
    assert access.open_reading is looks


def test_addresses_that_cannot_be_listened_on():
    with pytest.raises(InputError, match="not an IP address"):
        bind("lab", 0)
    with pytest.raises(InputError, match=r"cannot listen on 192\.0\.2\.7"):
        bind("192.0.2.7", 0)
    with bind("127.0.0.1", 0) as sock, pytest.raises(InputError, match="choose another --port"):
        bind("127.0.0.1", sock.getsockname()[1])
