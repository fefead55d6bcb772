"""Reads the JSON of a request and reports bad input as one line."""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable
from typing import Any

from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from firmware_py.recording.errors import RecordingError
from hal.errors import HalError
from tools.errors import InputError

Handler = Callable[[Request], Awaitable[Response]]


def clear(handler: Callable[[Request], Awaitable[Any]]) -> Handler:
    """A handler whose bad input is one line for the page."""

    async def wrapped(request: Request) -> Response:
        try:
            result = await handler(request)
        except (InputError, RecordingError, HalError) as error:
            return JSONResponse({"error": str(error)}, 400)
        return result if isinstance(result, Response) else JSONResponse({"ok": True} if result is None else result)

    return wrapped


async def body(request: Request) -> dict[str, Any]:
    """Return the JSON object of a request. Raises ``InputError`` when it is none."""
    try:
        value = json.loads(await request.body() or b"{}")
    except (ValueError, RecursionError):
        raise InputError("the request is not JSON") from None
    if not isinstance(value, dict):
        raise InputError("the request is not a JSON object")
    return value


def text(table: dict[str, Any], key: str, default: str = "", longest: int = 2000) -> str:
    """Return a text of the request."""
    value = table.get(key, default)
    if not isinstance(value, str) or len(value) > longest:
        raise InputError(f"{key} must be a text of at most {longest} characters")
    return value
