"""Handles the bench page's orders to a running loop: the safe state and the end of a hold for every instrument, other
orders by the instrument that defines them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from firmware_py.run.context import Run
from firmware_py.run.findings import Finding


class PageOrders:
    """Handles the orders that have arrived. ``handle_own(order, now_ns)`` gets the instrument's own orders with the
    bench time (ns), and drops invalid ones. ``host_ns`` is the clock of the page's time stamps, ``CLOCK_MONOTONIC``."""

    def __init__(
        self,
        run: Run,
        handle_own: Callable[[Mapping[str, Any], int], None],
        host_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._run = run
        self._handle_own = handle_own
        self._host_ns = host_ns

    def handle_orders(self) -> None:
        """Handle every order that has arrived since the last call. Has no effect without a page."""
        if self._run.live is not None:
            for order in self._run.live.orders():
                self._handle(order)

    def _handle(self, order: Mapping[str, Any]) -> None:
        run, incidents = self._run, self._run.incidents
        now_ns = run.clock.now_ns()
        match order:
            case {"order": "safe"}:
                asked_ns = order.get("t_ns")
                # the page stamps with the host's clock, which is not the bench's where bench time is emulated
                age_ns = self._host_ns() - asked_ns if isinstance(asked_ns, int) else 0
                run.asked_safe_ns = now_ns - max(0, age_ns)
                incidents.report(Finding.STOPPED_ON_PAGE)
            case {"order": "rearm"}:
                if not incidents.holds.ask():
                    incidents.note({"event": "rearm refused", "reason": incidents.holds.waits_for})
            case _:
                self._handle_own(order, now_ns)
