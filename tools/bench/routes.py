"""Joins the requests of the single views."""

from __future__ import annotations

import json
from typing import Any

from starlette.requests import Request
from starlette.responses import FileResponse
from starlette.routing import BaseRoute, Route

from firmware_py.sensing.config import attitude_methods
from tools.bench.applied import Applied
from tools.bench.calibrate import calibrate_routes
from tools.bench.collect import collect_routes
from tools.bench.dropped import dropped_routes
from tools.bench.jobs import Jobs
from tools.bench.layouts import layout_routes
from tools.bench.mismatch import mismatch_routes
from tools.bench.requests import body, clear, text
from tools.bench.session import Session
from tools.bench.setup import setup_routes
from tools.bench.shadow import check_method
from tools.calibrate.calibration_file import calibration_toml
from tools.errors import InputError


def more_routes(session: Session, jobs: Jobs) -> list[BaseRoute]:
    """Return the routes of the views, without those of the core."""
    applied = Applied(session)
    return [
        *_attitude(session, applied),
        *_targets(session),
        *layout_routes(session.layouts),
        *collect_routes(session, jobs),
        *dropped_routes(session, session.dropped),
        *mismatch_routes(session, jobs, applied),
        *calibrate_routes(session, jobs, applied),
        *setup_routes(session),
    ]


def _targets(session: Session) -> list[BaseRoute]:
    targets = session.targets

    async def state(_: Request) -> Any:
        return {"reports": targets.reports()}

    async def start(request: Request) -> Any:
        table = await body(request)
        seed = table.get("seed", 1)
        if not isinstance(seed, int) or not 0 <= seed < 1 << 31:
            raise InputError("seed must be a whole number, 0 or more")
        name = text(table, "user", "user", longest=60)
        source = text(table, "source", "mouse")
        targets.start(name, text(table, "mapping", "position"), source, seed, session.layout)

    async def report(request: Request) -> Any:
        path = targets.report(request.path_params["name"])
        return FileResponse(path, filename=path.name)

    return [
        Route("/api/targets", clear(state)),
        Route("/api/targets/start", clear(start), methods=["POST"]),
        Route("/api/targets/reports/{name}", clear(report)),
    ]


def _attitude(session: Session, applied: Applied) -> list[BaseRoute]:
    async def filters(_: Request) -> Any:
        stages = json.loads(session.metadata().get("stages", "{}"))
        running = stages.get("sensing", {}).get("attitude_method", "")
        return {
            "methods": attitude_methods() if stages else (),
            "running": running,
            "stages": stages,
            "applied": applied.what,
        }

    async def compare(request: Request) -> Any:
        await session.compare(text(await body(request), "method"))

    async def use(request: Request) -> Any:
        """The firmware starts again with another filter."""
        method = text(await body(request), "method")
        check_method(method)
        stages = {"sensing": {"attitude_method": method}}
        await applied.calibration("attitude filter", calibration_toml("attitude filter", "micron bench", stages))

    return [
        Route("/api/filters", clear(filters)),
        Route("/api/compare", clear(compare), methods=["POST"]),
        Route("/api/filters/use", clear(use), methods=["POST"]),
    ]
