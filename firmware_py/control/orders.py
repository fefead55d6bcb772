"""Obeys the bench page's orders to a running loop: safe state, end of a hold, jogging by hand, compensation gain."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from firmware_py.control.manual import ManualDrive
from firmware_py.control.stages import Stages
from firmware_py.live.link import LiveLink
from firmware_py.run.findings import Finding
from firmware_py.run.incidents import Incidents
from firmware_py.run.safety import Supervisor
from hal.contracts import Clock

MAX_GAIN = 1.5


class PageOrders:
    """Obeys the orders that have arrived, and drops invalid ones. ``asked_safe_ns`` is the bench time at which the page
    asked for the safe state."""

    def __init__(
        self,
        link: LiveLink,
        manual: ManualDrive,
        stages: Stages,
        supervisor: Supervisor,
        incidents: Incidents,
        clock: Clock,
        host_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._link = link
        self._manual = manual
        self._stages = stages
        self._supervisor = supervisor
        self._incidents = incidents
        self._clock = clock
        self._host_ns = host_ns
        self.asked_safe_ns: int | None = None

    def obey_all(self) -> None:
        for order in self._link.orders():
            self._obey(order)

    def _obey(self, order: Mapping[str, Any]) -> None:
        now_ns = self._clock.now_ns()
        match order:
            case {"order": "safe"}:
                asked_ns = order.get("t_ns")
                # the page stamps with the host's clock, which is not the bench's where bench time is emulated
                age_ns = self._host_ns() - asked_ns if isinstance(asked_ns, int) else 0
                self.asked_safe_ns = now_ns - max(0, age_ns)
                self._incidents.report(Finding.STOPPED_ON_PAGE)
            case {"order": "rearm"}:
                if not self._incidents.holds.ask():
                    self._incidents.note({"event": "rearm refused", "reason": self._incidents.holds.waits_for})
            case {"order": "arm"} if self._supervisor.may_move:
                self._manual.arm(now_ns, self._stages.command_V)
            case {"order": "disarm"}:
                self._manual.disarm()
            case {"order": "jog", "channel": int(channel), "rate_V_per_s": float(rate) | int(rate)}:
                self._manual.jog(now_ns, channel, float(rate))
            case {"order": "gain", "value": float(gain) | int(gain)} if 0.0 <= gain <= MAX_GAIN:
                self._stages.actuation.params["gain"] = float(gain)
                self._incidents.note({"event": "compensation gain", "value": float(gain)})
            case _:
                return
