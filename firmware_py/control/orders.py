"""Obeys the bench page's orders that only this instrument has: jogging by hand, and the compensation's gain."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from firmware_py.control.manual import ManualDrive
from firmware_py.control.stages import Stages
from firmware_py.run.context import Run

MAX_GAIN = 1.5


class HandOrders:
    """Obeys orders for ``manual`` and ``stages``, and drops invalid ones."""

    def __init__(self, manual: ManualDrive, stages: Stages, run: Run) -> None:
        self._manual = manual
        self._stages = stages
        self._run = run

    def obey(self, order: Mapping[str, Any], now_ns: int) -> None:
        """Obey ``order``, which came at ``now_ns``."""
        match order:
            case {"order": "arm"} if self._run.supervisor.may_move:
                self._manual.arm(now_ns, self._stages.command_V)
            case {"order": "disarm"}:
                self._manual.disarm()
            case {"order": "jog", "channel": int(channel), "rate_V_per_s": float(rate) | int(rate)}:
                self._manual.jog(now_ns, channel, float(rate))
            case {"order": "gain", "value": float(gain) | int(gain)} if 0.0 <= gain <= MAX_GAIN:
                self._stages.actuation.params["gain"] = float(gain)
                self._run.incidents.note({"event": "compensation gain", "value": float(gain)})
            case _:
                return
