"""Decides which requests may read and which may change something, as an ASGI layer in front of everything.

* The Host must be one that the server listens on (a foreign name that resolves to this machine is refused).
* A request with an Origin must come from the page itself.
* What changes state needs the token, in the header ``X-Micron-Token``; behind ``--listen`` everything but the static
  page does.
* A body may have ``MAX_BODY_BYTES`` and take ``BODY_S``; a longer one is refused before it is read, or where it becomes
  too long.
* A file for ``UPLOADS`` may have ``MAX_UPLOAD_BYTES``; it needs the token, and the route reads it in parts.
* Requests without the token have ``MAX_REQUESTS`` places, ``MAX_OF_CLIENT`` for one address. Those with the token are
  not counted: an order always finds a place.
"""

from __future__ import annotations

import asyncio
import hmac
from collections import Counter
from dataclasses import dataclass

from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

MAX_BODY_BYTES = 65_536
MAX_UPLOAD_BYTES = 200_000_000
UPLOADS = "/api/upload/"
"""Files come here: with the token alone, read in parts by the route, which has limits of its own."""
BODY_S = 10.0
MAX_REQUESTS = 48
MAX_OF_CLIENT = 32
SAFE_METHODS = ("GET", "HEAD")
POLICY = (
    "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "frame-src 'self' blob:; connect-src 'self' ws: wss:; frame-ancestors 'self'; base-uri 'none'; form-action 'none'"
)


@dataclass(frozen=True)
class Access:
    """Holds the rules: ``hosts`` lists allowed Host headers with port; with ``open_reading``, reading needs no token
    (loopback)."""

    token: str
    hosts: frozenset[str]
    open_reading: bool

    def knows(self, token: str | None) -> bool:
        """Return True for the right token. Every wrong one takes the same time."""
        return token is not None and hmac.compare_digest(token.encode(), self.token.encode())

    def same_origin(self, origin: str | None) -> bool:
        """Return True if a page of this server asks. Programs that are not browsers send no Origin."""
        return origin is None or origin.partition("://")[2] in self.hosts


class _TooLarge(Exception):
    pass


class _TooSlow(Exception):
    pass


class Guard:
    """Checks every request before the application sees it."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app = app
        self._access = access
        self._open: Counter[str] = Counter()  # requests without the token that are in progress, by address

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = {k.decode("latin-1").lower(): v.decode("latin-1") for k, v in scope["headers"]}
        refusal = self._refusal(scope, headers)
        if refusal is None and scope["type"] == "websocket":
            await self._pass_on(scope, receive, send)
        elif refusal is None:
            await self._in_a_place(scope, headers, receive, send)
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 4403, "reason": refusal[1][:100]})
        else:
            await JSONResponse({"error": refusal[1]}, refusal[0])(scope, receive, send)

    def _refusal(self, scope: Scope, headers: dict[str, str]) -> tuple[int, str] | None:
        if headers.get("host", "").lower() not in self._access.hosts:
            return 421, "this server does not answer to that host name"
        if not self._access.same_origin(headers.get("origin")):
            return 403, "another page may not use this bench"
        if scope["type"] == "websocket":
            return None  # asks for the token in its first message
        length = headers.get("content-length", "0")
        most = MAX_UPLOAD_BYTES if self._is_upload(scope, headers) else MAX_BODY_BYTES
        if not length.isdigit() or int(length) > most:
            known = self._access.knows(headers.get("x-micron-token")) or not scope["path"].startswith(UPLOADS)
            what = f"{most // 1_000_000} MB" if most == MAX_UPLOAD_BYTES else f"{most} bytes"
            return (413, f"a request may have {what}") if known else (403, "token missing or wrong")
        changes = scope["method"] not in SAFE_METHODS
        private = scope["path"].startswith("/api/") and not self._access.open_reading
        if (changes or private) and not self._access.knows(headers.get("x-micron-token")):
            return 403, "token missing or wrong: open the address that 'micron bench' printed"
        return None

    def _is_upload(self, scope: Scope, headers: dict[str, str]) -> bool:
        """Return True for a file from somebody who has the token."""
        known = self._access.knows(headers.get("x-micron-token"))
        return known and scope["method"] == "PUT" and scope["path"].startswith(UPLOADS)

    async def _in_a_place(self, scope: Scope, headers: dict[str, str], receive: Receive, send: Send) -> None:
        """A request that may be answered, counted unless it has the token, with its body read."""
        client = "" if self._access.knows(headers.get("x-micron-token")) else (scope.get("client") or ("?",))[0]
        if client and (self._open.total() >= MAX_REQUESTS or self._open[client] >= MAX_OF_CLIENT):
            await _refuse(503, "too many requests at once; try again", scope, receive, send)
            return
        if client:
            self._open[client] += 1
        try:
            announced = headers.get("content-length", "0") != "0" or "transfer-encoding" in headers
            if (announced or scope["method"] not in SAFE_METHODS) and not self._is_upload(scope, headers):
                receive = _replay(await _whole_body(receive), receive)
            await self._pass_on(scope, receive, send)
        except _TooLarge:
            await _refuse(413, f"a request may have {MAX_BODY_BYTES} bytes", scope, receive, send)
        except _TooSlow:
            await _refuse(408, f"the body of the request took more than {BODY_S:.0f} s", scope, receive, send)
        finally:
            if client:
                self._open[client] -= 1
                if not self._open[client]:
                    del self._open[client]

    async def _pass_on(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [
                    *message.get("headers", []),
                    (b"content-security-policy", POLICY.encode()),
                    (b"x-content-type-options", b"nosniff"),
                    (b"referrer-policy", b"no-referrer"),
                    (b"cache-control", b"no-cache"),
                ]
            await send(message)

        await self._app(scope, receive, send_with_headers)


async def _refuse(status: int, why: str, scope: Scope, receive: Receive, send: Send) -> None:
    """Answer and close: what is left of the request is not read."""
    await JSONResponse({"error": why}, status, {"Connection": "close"})(scope, receive, send)


async def _whole_body(receive: Receive) -> bytes:
    """Return the body, at most ``MAX_BODY_BYTES``. Raises ``_TooLarge`` or ``_TooSlow`` beyond a limit."""
    parts: list[bytes] = []
    size = 0
    try:
        async with asyncio.timeout(BODY_S):
            while True:
                message = await receive()
                if message["type"] != "http.request":  # the client has gone
                    return b""
                parts.append(message.get("body", b""))
                size += len(parts[-1])
                if size > MAX_BODY_BYTES:
                    raise _TooLarge
                if not message.get("more_body", False):
                    return b"".join(parts)
    except TimeoutError:
        raise _TooSlow from None


def _replay(body: bytes, receive: Receive) -> Receive:
    """Give ``body`` first, then what ``receive`` says."""
    given = False

    async def again() -> Message:
        nonlocal given
        if given:
            return await receive()
        given = True
        return {"type": "http.request", "body": body, "more_body": False}

    return again
