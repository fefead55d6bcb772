"""What the bench page may ask of a running loop: the safe state, jogging by hand, the gain of the compensation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from firmware_py.control.incidents import Incidents
from firmware_py.control.manual import ManualDrive
from firmware_py.control.safety import Supervisor
from firmware_py.control.stages import Stages
from firmware_py.live.link import LiveLink
from hal.contracts import Clock

MAX_GAIN = 1.5


class PageOrders:
    """Obeys the orders that have arrived; one that makes no sense is dropped. ``asked_safe_ns``: when the safe state
    was asked for, by the page's clock."""

    def __init__(
        self,
        link: LiveLink,
        manual: ManualDrive,
        stages: Stages,
        supervisor: Supervisor,
        incidents: Incidents,
        clock: Clock,
    ) -> None:
        self._link = link
        self._manual = manual
        self._stages = stages
        self._supervisor = supervisor
        self._incidents = incidents
        self._clock = clock
        self.asked_safe_ns: int | None = None

    def obey_all(self) -> None:
        for order in self._link.orders():
            self._obey(order)

    def _obey(self, order: Mapping[str, Any]) -> None:
        now_ns = self._clock.now_ns()
        match order:
            case {"order": "safe"}:
                asked_ns = order.get("t_ns")
                self.asked_safe_ns = asked_ns if isinstance(asked_ns, int) else now_ns
                self._incidents.trip("stopped by the operator (safe button of the bench page)", normal=True)
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
