"""The log of a running bench page, line by line, over its websocket."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from datetime import datetime
from typing import Any
from urllib.parse import parse_qs, urlsplit

from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.sync.client import connect

from tools.errors import InputError


def follow(url: str, seconds: float | None) -> Iterator[dict[str, Any]]:
    """Lines as ``{n, time, when, level, text}``, old ones first. ``ConnectionError`` when nobody serves ``url``."""
    parts = urlsplit(url)
    if parts.scheme not in ("http", "https") or not parts.netloc:
        raise InputError(f"{url}: not an address; give what 'micron bench' printed")
    token = parse_qs(parts.fragment).get("token", [""])[0]
    end_s = None if seconds is None else time.monotonic() + seconds
    try:
        with connect(f"{'wss' if parts.scheme == 'https' else 'ws'}://{parts.netloc}/live", open_timeout=5) as ws:
            ws.send(json.dumps({"type": "hello", "token": token}))
            while end_s is None or time.monotonic() < end_s:
                try:
                    message = ws.recv(1.0)
                except TimeoutError:
                    continue
                table = json.loads(message) if isinstance(message, str) else {}
                for line in table.get("lines", ()) if table.get("type") == "log" else ():
                    when = datetime.fromtimestamp(line["time"]).strftime("%H:%M:%S")
                    yield {**line, "when": when}
    except ConnectionClosed as error:
        raise ConnectionError(f"{url}: the bench page has ended or refused us ({error})") from error
    except (OSError, WebSocketException) as error:
        raise ConnectionError(f"{url}: no bench page there ({error}); start one with 'micron bench'") from error
