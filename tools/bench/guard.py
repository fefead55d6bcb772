"""Who may ask and who may change something: an ASGI layer in front of everything.

* The Host must be one that the server listens on (a foreign name that resolves to this machine is refused).
* A request with an Origin must come from the page itself.
* What changes state needs the token, in the header ``X-Micron-Token``; behind ``--listen`` everything but the static
  page does.
* A body may have ``MAX_BODY_BYTES``; a longer one is refused before it is read.
"""

from __future__ import annotations

import hmac
from dataclasses import dataclass

from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

MAX_BODY_BYTES = 65_536
SAFE_METHODS = ("GET", "HEAD")
POLICY = (
    "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "frame-src 'self' blob:; connect-src 'self' ws: wss:; frame-ancestors 'self'; base-uri 'none'; form-action 'none'"
)


@dataclass(frozen=True)
class Access:
    """``hosts``: what the Host header may say, with port. ``open_reading``: looking needs no token (loopback)."""

    token: str
    hosts: frozenset[str]
    open_reading: bool

    def knows(self, token: str | None) -> bool:
        """Whether that is the token; takes the same time for every wrong one."""
        return token is not None and hmac.compare_digest(token.encode(), self.token.encode())

    def same_origin(self, origin: str | None) -> bool:
        """Whether a page of this server asks; programs that are not browsers send no Origin."""
        return origin is None or origin.partition("://")[2] in self.hosts


class _TooLarge(Exception):
    pass


class Guard:
    """The layer."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app = app
        self._access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = {k.decode("latin-1").lower(): v.decode("latin-1") for k, v in scope["headers"]}
        refusal = self._refusal(scope, headers)
        if refusal is None:
            await self._pass_on(scope, receive, send)
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
        if not length.isdigit() or int(length) > MAX_BODY_BYTES:
            return 413, f"a request may have {MAX_BODY_BYTES} bytes"
        changes = scope["method"] not in SAFE_METHODS
        private = scope["path"].startswith("/api/") and not self._access.open_reading
        if (changes or private) and not self._access.knows(headers.get("x-micron-token")):
            return 403, "token missing or wrong: open the address that 'micron bench' printed"
        return None

    async def _pass_on(self, scope: Scope, receive: Receive, send: Send) -> None:
        started = False
        got = 0

        async def bounded_receive() -> Message:
            nonlocal got
            message = await receive()
            got += len(message.get("body", b""))
            if scope["type"] == "http" and got > MAX_BODY_BYTES:
                raise _TooLarge
            return message

        async def send_with_headers(message: Message) -> None:
            nonlocal started
            if message["type"] == "http.response.start":
                started = True
                message["headers"] = [
                    *message.get("headers", []),
                    (b"content-security-policy", POLICY.encode()),
                    (b"x-content-type-options", b"nosniff"),
                    (b"referrer-policy", b"no-referrer"),
                    (b"cache-control", b"no-cache"),
                ]
            await send(message)

        try:
            await self._app(scope, bounded_receive, send_with_headers)
        except _TooLarge:
            if not started:
                answer = JSONResponse({"error": f"a request may have {MAX_BODY_BYTES} bytes"}, 413)
                await answer(scope, receive, send)
