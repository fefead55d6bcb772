"""Defines the routes: a static page, one websocket, and the requests that change something."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import BaseRoute, Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket

from firmware_py.frame import Layout
from hal.bench import load_bench
from tools.bench.firmware import Choice, why_not_compiled
from tools.bench.guard import Access, Guard
from tools.bench.requests import body, clear, text
from tools.bench.session import Session
from tools.bench.viewer import Viewer
from tools.errors import InputError

STATIC = Path(__file__).with_name("static")
MAX_VIEWERS = 16
RESERVED_VIEWERS = 4
"""Further places for pages that show the token within ``viewer.HELLO_S``."""


def catalogue(layout: Layout) -> list[dict[str, Any]]:
    """Return every scalar of the instrument's frame. ``plotted``: the scope shows it first."""
    return [
        {
            "name": name,
            "unit": column.unit,
            "group": column.name,
            "what": column.what,
            "plotted": column.name in layout.plotted,
        }
        for column in layout
        for name in column.scalar_names()
    ]


def known_bench(session: Session, name: str) -> Path:
    """Return the bench file called ``name``, which lies beside the one that was given; the present one for an empty
    name. Raises ``InputError``."""
    if name and Path(name) not in session.home.glob("*.toml"):
        raise InputError(f"{name} is not one of the benches in {session.home}")
    return Path(name) if name else session.choice.bench


def read_choice(session: Session, table: dict[str, Any]) -> Choice:
    """Return the choice of the next run from the request to start it. Raises ``InputError``.

    Without ``compiled`` the loop of the present bench stays what it is, and another bench runs in Python.
    """
    bench = known_bench(session, text(table, "bench"))
    is_same = bench == session.choice.bench
    flags = {"sense_only": False, "compiled": session.choice.compiled and is_same}
    for key in flags:
        flags[key] = table.get(key, flags[key])
        if not isinstance(flags[key], bool):
            raise InputError(f"{key} must be true or false")
    if table.get("compiled") and flags["sense_only"]:
        raise InputError("a compiled run moves outputs, and one that senses only moves none; choose one of them")
    return replace(session.choice, bench=bench, **flags)


def core_routes(session: Session, access: Access) -> list[BaseRoute]:
    """Return the routes of page, websocket, firmware and recordings."""
    viewers: set[Viewer] = set()

    async def page(_: Request) -> Response:
        return FileResponse(STATIC / "index.html")

    async def channels(_: Request) -> Any:
        return {"instrument": session.layout.instrument, "channels": catalogue(session.layout)}

    async def benches(_: Request) -> Any:
        return {"benches": sorted(str(p) for p in session.home.glob("*.toml")), "now": str(session.choice.bench)}

    async def compiled(request: Request) -> Any:
        """Say why a bench cannot run compiled; the present one where the request names none."""
        bench = known_bench(session, request.query_params.get("bench", ""))
        return {"why": await asyncio.to_thread(lambda: why_not_compiled(load_bench(bench)))}

    async def safe(_: Request) -> Any:
        return {"ok": session.order("safe")}

    async def start(request: Request) -> Any:
        table = await body(request)
        await session.start(read_choice(session, table))

    async def stop(_: Request) -> Any:
        await session.stop()

    async def look(socket: WebSocket) -> None:
        if len(viewers) >= MAX_VIEWERS + RESERVED_VIEWERS:
            await socket.close(1013, "too many viewers")
            return
        crowded = len(viewers) >= MAX_VIEWERS
        viewer = Viewer(socket, session, replace(access, open_reading=False) if crowded else access)
        viewers.add(viewer)
        try:
            await viewer.serve()
        finally:
            viewers.discard(viewer)

    return [
        Route("/", page),
        Route("/api/channels", clear(channels)),
        Route("/api/benches", clear(benches)),
        Route("/api/benches/compiled", clear(compiled)),
        Route("/api/safe", clear(safe), methods=["POST"]),
        Route("/api/firmware/start", clear(start), methods=["POST"]),
        Route("/api/firmware/stop", clear(stop), methods=["POST"]),
        WebSocketRoute("/live", look),
    ]


def make_app(session: Session, access: Access, more_routes: list[BaseRoute] | None = None) -> Guard:
    """Return the application. The firmware starts and ends with it."""

    @contextlib.asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        pump = asyncio.create_task(session.run_forever())
        await session.start()
        try:
            yield
        finally:
            await session.stop()
            pump.cancel()
            await asyncio.gather(pump, return_exceptions=True)

    routes = [*core_routes(session, access), *(more_routes or []), Mount("/static", StaticFiles(directory=STATIC))]
    return Guard(Starlette(routes=routes, lifespan=lifespan), access)
