"""A viewer that armed the jogging and leaves, by whatever way, takes the order back."""

from __future__ import annotations

import asyncio
import json
from typing import Any, cast

import pytest

from tools.bench.guard import Access
from tools.bench.viewer import Viewer

HELLO = {"type": "hello", "token": "right"}
ARM = {"type": "order", "order": "arm"}
DISARM = {"type": "order", "order": "disarm"}


class Socket:
    """A page that says ``words`` and then leaves: by closing, by an error, or by never coming back."""

    def __init__(self, words: list[dict[str, Any]], leaving: str) -> None:
        self.words, self.leaving = list(words), leaving
        self.all_said = asyncio.Event()

    async def accept(self) -> None:
        pass

    async def receive(self) -> dict[str, Any]:
        if self.words:
            return {"type": "websocket.receive", "text": json.dumps(self.words.pop(0))}
        self.all_said.set()
        if self.leaving == "error":
            raise ConnectionResetError
        if self.leaving == "closes":
            return {"type": "websocket.disconnect"}
        await asyncio.Event().wait()
        raise AssertionError

    async def send_text(self, text: str) -> None:
        raise ConnectionResetError

    send_bytes = send_json = send_text

    async def close(self, code: int, reason: str = "") -> None:
        pass


class Session:
    """Takes orders; ``grants``: whether arming succeeds."""

    def __init__(self, grants: bool) -> None:
        self.orders: list[str] = []
        self.grants = grants
        self.frame_ready = asyncio.Event()

    def order(self, name: str, **more: object) -> bool:
        self.orders.append(name)
        return self.grants


async def served(words: list[dict[str, Any]], leaving: str, grants: bool = True) -> list[str]:
    session, socket = Session(grants), Socket(words, leaving)
    access = Access("right", frozenset(), open_reading=True)
    serving = asyncio.create_task(Viewer(cast(Any, socket), cast(Any, session), access).serve())
    await asyncio.wait_for(socket.all_said.wait(), 30)
    if leaving == "server ends":
        await asyncio.sleep(0)
        serving.cancel()
    await asyncio.wait([serving], timeout=30)
    assert serving.done()
    return session.orders


@pytest.mark.parametrize("leaving", ["closes", "error", "server ends"])
def test_it_is_disarmed_however_it_leaves(leaving: str) -> None:
    assert asyncio.run(served([HELLO, ARM], leaving)) == ["arm", "disarm"]


@pytest.mark.parametrize(
    ("words", "grants", "orders"),
    [
        ([HELLO], True, []),
        ([ARM], True, []),  # no token
        ([HELLO, ARM], False, ["arm"]),  # refused: another page may be armed
        ([HELLO, ARM, DISARM], True, ["arm", "disarm"]),
        ([HELLO, ARM, DISARM, ARM], True, ["arm", "disarm", "arm", "disarm"]),
    ],
)
def test_who_is_not_armed_takes_nothing_back(words: list[dict[str, Any]], grants: bool, orders: list[str]) -> None:
    assert asyncio.run(served(words, "closes", grants)) == orders
