"""Requests of the single views, joined."""

from __future__ import annotations

from starlette.routing import BaseRoute

from tools.bench.session import Session


def more_routes(session: Session) -> list[BaseRoute]:
    """Everything besides the core."""
    return []
