"""The server's own process: addresses, token, uvicorn."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import secrets
import signal
import socket
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import uvicorn

from tools.bench.app import make_app
from tools.bench.firmware import Choice
from tools.bench.guard import Access, Guard
from tools.bench.jobs import Jobs
from tools.bench.limits import BoundedHttp
from tools.bench.routes import more_routes
from tools.bench.session import Session
from tools.errors import InputError

if TYPE_CHECKING:
    from tools.mismatch.watch.live import Settings

LOOPBACK = "127.0.0.1"
MAX_MESSAGE_BYTES = 65_536


def bind(address: str, port: int) -> socket.socket:
    """Return a listening socket (``port`` 0: any free port). Raises ``InputError`` when it cannot listen."""
    try:
        family = socket.AF_INET6 if ipaddress.ip_address(address).version == 6 else socket.AF_INET
    except ValueError:
        raise InputError(f"--listen {address}: not an IP address") from None
    sock = socket.socket(family)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind((address, port))
        sock.listen(128)  # who comes before the server is ready waits instead of being refused
    except OSError as error:
        sock.close()
        raise InputError(f"cannot listen on {address}, port {port}: {error.strerror}; choose another --port") from error
    return sock


def access_for(address: str, port: int, token: str, names: tuple[str, ...] = ()) -> Access:
    """Return the access rules: reading is free on loopback only. ``names`` are further host names that may be used."""
    loopback = ipaddress.ip_address(address).is_loopback
    hosts = {address if ":" not in address else f"[{address}]", *names}
    if loopback:
        hosts |= {"localhost", LOOPBACK}
    elif ipaddress.ip_address(address).is_unspecified:
        hosts |= {"localhost", LOOPBACK, socket.gethostname(), *_own_addresses()}
    return Access(token, frozenset(f"{host.lower()}:{port}" for host in hosts), open_reading=loopback)


def _own_addresses() -> set[str]:
    try:
        return {str(info[4][0]) for info in socket.getaddrinfo(socket.gethostname(), None)}
    except OSError:
        return set()


def config_for(app: Guard) -> uvicorn.Config:
    """Return the settings with which uvicorn serves the page."""
    return uvicorn.Config(
        app,
        http=BoundedHttp,  # has its own limits; uvicorn's would refuse orders, too
        ws="websockets-sansio",
        ws_max_size=MAX_MESSAGE_BYTES,
        ws_per_message_deflate=False,  # costs more than a loopback saves
        access_log=False,
        log_level="warning",
        server_header=False,
        timeout_graceful_shutdown=1,
    )


def serve(
    choice: Choice,
    recordings: Path,
    sock: socket.socket,
    announce: Callable[[str], None],
    *,
    names: tuple[str, ...] = (),
    token: str | None = None,
    watch: Settings | None = None,
) -> None:
    """Run until SIGINT or SIGTERM; the firmware is then in its safe state. ``announce`` gets the page's address.

    SIGINT ends with KeyboardInterrupt, as everywhere. A second signal ends the process at once; the firmware then
    reaches its safe state by itself, because its parent has died.
    """
    address, port = sock.getsockname()[:2]
    token = token or secrets.token_urlsafe(24)
    access = access_for(address, port, token, names)

    interrupted: list[bool] = []

    async def run() -> None:
        session = Session(choice, recordings, watch)
        jobs = Jobs()
        app = make_app(session, access, more_routes(session, jobs))
        server = uvicorn.Server(config_for(app))
        # signals are ours: two handlers would take one Ctrl-C for two of them, and not wait for the firmware
        server.capture_signals = contextlib.nullcontext  # type: ignore[method-assign]
        loop = asyncio.get_running_loop()
        stopping: list[asyncio.Task[None]] = []

        def leave(number: int) -> None:
            if server.should_exit:
                signal.signal(number, signal.SIG_DFL)
                signal.raise_signal(number)
            interrupted.append(number == signal.SIGINT)
            server.should_exit = True
            stopping.append(loop.create_task(session.stop()))  # the outputs do not wait for open connections

        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, leave, number)
        host = address if not ipaddress.ip_address(address).is_unspecified else socket.gethostname()
        announce(f"http://{host if ':' not in host else f'[{host}]'}:{port}/#token={token}")
        try:
            await server.serve(sockets=[sock])
        finally:
            await asyncio.gather(*stopping)
            await jobs.close()
            session.dropped.close()

    asyncio.run(run())
    if any(interrupted):
        raise KeyboardInterrupt
