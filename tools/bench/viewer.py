"""Serves one open page: its subscriptions, its orders and its messages.

A viewer that does not read is waited for by its own task alone; when it reads again it gets the present, not the
past. A viewer that talks nonsense is cut off.
"""

from __future__ import annotations

import asyncio
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from starlette.websockets import WebSocket, WebSocketDisconnect

from firmware_py.frame import Layout
from firmware_py.recording.errors import RecordingError
from tools.bench.guard import Access
from tools.bench.history import Buckets, History, rows_per_bucket
from tools.bench.recorder import check_name, is_own_file
from tools.bench.replay import SPEEDS, RecordedHistory, Replay, open_recorded
from tools.bench.session import STATUS_S, Session
from tools.bench.wire import encode
from tools.errors import InputError

MAX_SUBSCRIPTIONS = 6
SHOWN, SECOND, LIVE = 0, 1, 2
"""Source of a subscription: the view of the page (live or a replay), the run laid over it, or the bench itself."""
MAX_CHANNELS = 64
MAX_PIXELS = 8192
MAX_NONSENSE = 100
ORDERS_PER_S = 100
HELLO_S = 5.0
SEND_S = 30.0
COUNTS_S = 0.5


class Nonsense(ValueError):
    """A message that the page would not send."""


@dataclass
class Subscription:
    """Holds one subscription. ``next_bucket`` is the first that the viewer does not have for good (None: it has nothing
    yet). ``sent_rows``: rows of the history when it was sent something last."""

    id: int
    layout: Layout
    channels: NDArray[np.intp]
    rows: int
    per_bucket: int
    source: int = SHOWN
    next_bucket: int | None = None
    sent_rows: int = 0


def _number(message: dict[str, Any], key: str, low: float, high: float) -> float:
    value = message.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise Nonsense(f"{key} must be a number from {low:g} to {high:g}")
    return value


def _channels(message: dict[str, Any], layout: Layout) -> NDArray[np.intp]:
    names, known = message.get("channels"), layout.scalar_names()
    if not isinstance(names, list) or len(names) > MAX_CHANNELS or any(name not in known for name in names):
        raise Nonsense("channels must be names of columns")
    return np.array([known.index(name) for name in names], dtype=np.intp)


def _source(message: dict[str, Any]) -> int:
    return int(_number(message, "source", SHOWN, LIVE)) if "source" in message else SHOWN


async def _read(
    history: History | RecordedHistory, channels: NDArray[np.intp], k: int, first: int, stop: int | None = None
) -> Buckets:
    """Answer from memory at once; from a file in a thread, so that nobody else waits for the disk."""
    if isinstance(history, RecordedHistory):
        return await asyncio.to_thread(history.buckets, channels, k, first, stop)
    return history.buckets(channels, k, first, stop)


class Viewer:
    """Serves one websocket until it closes."""

    def __init__(self, socket: WebSocket, session: Session, access: Access) -> None:
        self._socket = socket
        self._session = session
        self._access = access
        self._may_order = False
        self._may_look = access.open_reading
        self._subscriptions: dict[int, Subscription] = {}
        self._ranges: dict[int, bytes] = {}
        self._nonsense = 0
        self._armed = False
        self._wants_counts = False
        self._wants_game = False
        self._orders = 0
        self._orders_since_s = 0.0
        self._run = -1
        self._log_sent = 0
        self._is_new = True
        self._replay: Replay | None = None
        self._generation = 0
        self._replay_told: dict[str, Any] | None = None
        self._place_told: dict[str, Any] | None = None
        self._opening = asyncio.Lock()

    async def serve(self) -> None:
        """Serve both directions. The first that ends also ends the other. An armed viewer that goes away is
        disarmed."""
        await self._socket.accept()
        tasks = [asyncio.create_task(self._receive()), asyncio.create_task(self._send())]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            if self._armed:
                self._session.order("disarm")
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            if self._replay is not None:
                await self._replay.close()

    # -- from the page --------------------------------------------------------------------------------------

    async def _receive(self) -> None:
        opened_s = time.monotonic()
        while True:
            patience_s = None if self._may_look else max(0.0, opened_s + HELLO_S - time.monotonic())
            try:
                message = await asyncio.wait_for(self._socket.receive(), patience_s)
            except TimeoutError:
                await self._socket.close(4403, "no token")
                return
            if message["type"] == "websocket.disconnect":
                return
            try:
                await self._obey(_parse(message.get("text")))
            except Nonsense:
                self._nonsense += 1
                if self._nonsense > MAX_NONSENSE:
                    await self._socket.close(1008, "too many messages that make no sense")
                    return

    async def _obey(self, message: dict[str, Any]) -> None:
        match message.get("type"):
            case "hello":
                token = message.get("token")
                self._may_order = isinstance(token, str) and self._access.knows(token)
                self._may_look |= self._may_order
                self._run = -1  # greet (again)
            case "subscribe" if self._may_look:
                self._subscribe(message)
            case "unsubscribe":
                self._subscriptions.pop(int(_number(message, "id", 0, 1e9)), None)
            case "range" if self._may_look:
                await self._range(message)
            case "replay" if self._may_look:
                await self._order_replay(message)
            case "counts" if self._may_look:
                self._wants_counts = message.get("on") is True
            case "game" if self._may_look:
                self._wants_game = message.get("on") is True
            case "pointer" if self._may_order:
                psi, theta = _number(message, "psi", -180, 180), _number(message, "theta", -180, 180)
                self._session.targets.pointer(psi, theta, message.get("pressed") is True)
            case "pointer":
                pass
            case "order" if self._may_order:
                self._order(message)
            case "order":
                pass  # the page says so itself: it knows that it has no token
            case _:
                raise Nonsense("no such message")

    def _subscribe(self, message: dict[str, Any]) -> None:
        number = int(_number(message, "id", 0, 1e9))
        if number not in self._subscriptions and len(self._subscriptions) >= MAX_SUBSCRIPTIONS:
            raise Nonsense("too many subscriptions")
        rows = int(_number(message, "rows", 1, 1e6))
        k = rows_per_bucket(rows, int(_number(message, "pixels", 1, MAX_PIXELS)))
        layout = self._session.layout
        self._subscriptions[number] = Subscription(
            number, layout, _channels(message, layout), rows, k, _source(message)
        )

    async def _range(self, message: dict[str, Any]) -> None:
        """Send a part of the past once. A later request replaces an earlier one that is not sent yet."""
        first, stop = int(_number(message, "first", 0, 1e15)), int(_number(message, "stop", 0, 1e15))
        k = rows_per_bucket(max(1, stop - first), int(_number(message, "pixels", 1, MAX_PIXELS)))
        number = int(_number(message, "id", 0, 1e9))
        if len(self._ranges) >= MAX_SUBSCRIPTIONS and number not in self._ranges:
            raise Nonsense("too many requests at once")
        history = self._history(_source(message))
        if history is None:
            raise Nonsense("there is no second run")
        buckets = await _read(history, _channels(message, history.layout), k, first // k, -(-stop // k))
        self._ranges[number] = encode(buckets, number)

    def _history(self, source: int) -> History | RecordedHistory | None:
        """Return what a source of data is now; None for a second run that is not there."""
        if source == LIVE or self._replay is None:
            return None if source == SECOND else self._session.history
        if source == SECOND:
            return None if self._replay.second is None else self._replay.second.history
        return self._replay.first.history

    async def _order_replay(self, message: dict[str, Any]) -> None:
        """Open, move, play or close a recording; what cannot be is said to this page alone."""
        try:
            async with self._opening:
                await self._change_replay(message)
        except (InputError, RecordingError) as error:
            await self._socket.send_json({"type": "replay problem", "text": str(error)})

    async def _change_replay(self, message: dict[str, Any]) -> None:
        replay = self._replay
        if "name" in message:
            recorded = await open_recorded(self._recording(message["name"]), self._session.layout)
            self._replay, self._generation, self._replay_told, self._place_told = Replay(recorded), -1, None, None
            if replay is not None:
                await replay.close()
        elif message.get("close") is True and replay is not None:
            self._replay, self._run = None, -1  # greet the live run again
            await replay.close()
        elif replay is None:
            raise InputError("no recording is open in this page any more; open it again")
        elif "seek" in message:
            replay.seek(_number(message, "seek", -1e9, 1e9))
        elif "play" in message:
            replay.play(message["play"] is True)
        elif "speed" in message:
            if message["speed"] not in SPEEDS:
                raise Nonsense("no such speed")
            replay.speed = float(message["speed"])
        elif "shift" in message and replay.second is not None:
            await replay.lay_over(replay.second, _number(message, "shift", -1e6, 1e6))
        elif "second" in message:
            second = message["second"]
            layout = replay.first.history.layout
            await replay.lay_over(await open_recorded(self._recording(second), layout) if second else None)

    def _recording(self, name: Any) -> Path:
        path = self._session.recorder.path(check_name(name if isinstance(name, str) else ""))
        if not is_own_file(path):
            raise InputError(f"there is no recording {path.stem!r} in {path.parent}")
        if self._session.recorder.active and self._session.recorder.name == path.stem:
            raise InputError(f"{path.stem!r} is being recorded; stop it first")
        return path

    def _order(self, message: dict[str, Any]) -> None:
        now_s = time.monotonic()
        if now_s - self._orders_since_s > 1.0:
            self._orders, self._orders_since_s = 0, now_s
        self._orders += 1
        order = message.get("order")
        if order == "safe":
            self._session.order("safe")
        elif self._orders > ORDERS_PER_S:
            raise Nonsense("too many orders")
        elif order == "arm":
            self._armed = self._session.order("arm")
        elif order == "rearm":
            self._session.order("rearm")
        elif order == "disarm":
            self._armed = False
            self._session.order("disarm")
        elif order == "jog" and self._armed:
            channel = int(_number(message, "channel", 0, 2))
            self._session.order("jog", channel=channel, rate_V_per_s=_number(message, "rate_V_per_s", -1e3, 1e3))
        elif order == "gain":
            self._session.order("gain", value=_number(message, "value", 0.0, 1.5))

    # -- to the page ----------------------------------------------------------------------------------------

    async def _send(self) -> None:
        state_s = counts_s = 0.0
        while True:
            try:
                async with asyncio.timeout(SEND_S):
                    await self._session.frame_ready.wait()
                    now_s = time.monotonic()
                    if self._may_look:
                        await self._greet_new_run()
                        await self._move_replay()
                        for subscription in list(self._subscriptions.values()):
                            await self._send_new(subscription)
                        shadow = self._session.shadow
                        if shadow is not None:
                            await self._socket.send_json({"type": "shadow", "q": shadow.quaternion})
                        if self._wants_game:
                            await self._socket.send_json({"type": "game", "game": self._session.targets.as_dict()})
                        while self._ranges:
                            await self._socket.send_bytes(self._ranges.pop(next(iter(self._ranges))))
                        if now_s - state_s >= STATUS_S:
                            state_s = now_s
                            await self._send_state()
                        if self._wants_counts and now_s - counts_s >= COUNTS_S:
                            counts_s = now_s
                            await self._socket.send_json({"type": "counts", "counts": self._session.counts()})
            except (TimeoutError, WebSocketDisconnect, RuntimeError):
                return  # gone, or has not read for half a minute

    async def _greet_new_run(self) -> None:
        session = self._session
        if self._run == session.run_number:
            return
        self._run = session.run_number
        for subscription in self._subscriptions.values():
            if self._replay is None or subscription.source == LIVE:
                subscription.next_bucket = None
        await self._socket.send_json(
            {
                "type": "hello",
                "run": self._run,
                "may_order": self._may_order,
                "server": session.identity,
                "instrument": session.layout.instrument,
            }
        )

    async def _move_replay(self) -> None:
        """Move the replay on, and tell the page where it is; after a jump everything is sent again."""
        replay = self._replay
        if replay is None:
            if self._replay_told is not None:
                self._replay_told = None
                await self._socket.send_json({"type": "replay", "name": ""})
            return
        replay.advance()
        if replay.generation != self._generation:
            self._generation = replay.generation
            for subscription in self._subscriptions.values():
                if subscription.source != LIVE:
                    subscription.next_bucket = None
            await self._socket.send_json({"type": "jump"})
        table = replay.as_dict()
        if table != self._replay_told:
            self._replay_told = table
            await self._socket.send_json(table)
        place = replay.place()
        if place != self._place_told:
            self._place_told = place
            await self._socket.send_json(place)

    async def _send_new(self, subscription: Subscription) -> None:
        history, k = self._history(subscription.source), subscription.per_bucket
        if history is None or history.layout is not subscription.layout:
            return  # the page of another instrument, until it loads again
        newest = history.head // k
        oldest = max(0, history.head - subscription.rows) // k
        first = subscription.next_bucket
        if first is None or first < oldest:
            first = oldest
        rows = history.head
        if first * k >= rows or (subscription.next_bucket is not None and rows == subscription.sent_rows):
            return  # a bucket that is not full yet is sent again only with further rows
        generation = self._generation
        if history is self._session.history:
            buckets = self._session.live_buckets(subscription.channels, k, first)
        else:
            buckets = await _read(history, subscription.channels, k, first)
        if generation != self._generation or history is not self._history(subscription.source):
            return  # somebody has jumped meanwhile
        if buckets.t_s.size:
            subscription.next_bucket = min(newest, buckets.first + buckets.t_s.size)
            subscription.sent_rows = rows
            await self._socket.send_bytes(encode(buckets, subscription.id))

    async def _send_state(self) -> None:
        session = self._session
        may_order = "true" if self._may_order else "false"
        await self._socket.send_text(f'{session.state_text(fresh=self._is_new)},"may_order":{may_order}}}')
        self._is_new = False
        if session.log_number > self._log_sent:
            lines = [line for line in session.log if line["n"] > self._log_sent]
            self._log_sent = session.log_number
            await self._socket.send_json({"type": "log", "lines": lines})


def _parse(text: str | None) -> dict[str, Any]:
    try:
        message = json.loads(text or "")
    except (ValueError, RecursionError):
        raise Nonsense("not JSON") from None
    if not isinstance(message, dict):
        raise Nonsense("not an object")
    return message
