"""Drives the actuators by hand: jogs them for diagnosis, in place of the compensation.

A switch that must be renewed arms the manual drive. The outputs move only while a button is held: an order to move is
valid for ``HOLD_S``. When the switch is not renewed for ``ARM_S``, or is opened, the outputs go back to neutral at
``RETURN_V_PER_S`` and compensation fades in again.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from firmware_py.actuation.hysteresis import slopes_at, stack_stroke
from firmware_py.frame import CLIP, COMMAND, DESIRED_TIP, STROKE
from firmware_py.records import Record
from hal.compiled import kernel

HOLD_S = 0.15
ARM_S = 1.0
MAX_RATE_V_PER_S = 200.0
RETURN_V_PER_S = 200.0


class ManualDrive:
    """Computes the outputs that the operator's orders ask for. ``active`` is True while the manual drive determines
    the outputs, ``armed`` returns True while orders may move them."""

    def __init__(self, low_V: float, high_V: float, neutral_V: float) -> None:
        self._low_V, self._high_V, self._neutral_V = low_V, high_V, neutral_V
        self._target_V = np.full(3, neutral_V)
        self._rate_V_per_s = 0.0
        self._channel = 0
        self._armed_until_ns = self._hold_until_ns = self._last_ns = 0
        self.active = False

    def armed(self, now_ns: int) -> bool:
        return self.active and now_ns < self._armed_until_ns

    def arm(self, now_ns: int, command_V: NDArray[np.float64]) -> None:
        """Take over the outputs at ``command_V`` (3,) V, or renew the time for which the drive is armed."""
        if not self.active:
            self._target_V[:] = command_V
            self._last_ns = now_ns
            self.active = True
        self._armed_until_ns = now_ns + round(ARM_S * 1e9)

    def disarm(self) -> None:
        self._armed_until_ns = self._hold_until_ns = 0

    def stop(self) -> None:
        """End the manual drive without a return to neutral, because the outputs have been taken there already."""
        self.disarm()
        self._target_V[:] = self._neutral_V
        self.active = False

    def jog(self, now_ns: int, channel: int, rate_V_per_s: float) -> None:
        """Move ``channel`` 0..2 for the next ``HOLD_S``. Has no effect when not armed or for invalid arguments."""
        if self.armed(now_ns) and channel in (0, 1, 2) and math.isfinite(rate_V_per_s):
            self._channel = channel
            self._rate_V_per_s = max(-MAX_RATE_V_PER_S, min(MAX_RATE_V_PER_S, rate_V_per_s))
            self._hold_until_ns = now_ns + round(HOLD_S * 1e9)

    def step(self, now_ns: int) -> NDArray[np.float64]:
        """Return the outputs (3,) V wanted now. Ends the manual drive once it has returned to neutral."""
        passed_s = min(0.01, (now_ns - self._last_ns) * 1e-9)
        self._last_ns = now_ns
        target = self._target_V
        if not self.armed(now_ns):
            step = RETURN_V_PER_S * passed_s
            target += np.clip(self._neutral_V - target, -step, step)
            self.active = bool(np.any(target != self._neutral_V))
        elif now_ns < self._hold_until_ns:
            moved = target[self._channel] + self._rate_V_per_s * passed_s
            target[self._channel] = max(self._low_V, min(self._high_V, moved))
        return target


@kernel
def follow_kernel(frame: NDArray[np.float64], states: Record, params: Record) -> None:
    """Let the stage follow a ``command`` that something else chose. The model's memory moves along, compensation is
    off, and ``stroke`` is what the hysteresis model predicts for the command."""
    state = states[0]
    param = params[0]
    for i in range(3):
        stack = param.stacks[i]
        plays = state.plays[i]
        command = frame[COMMAND + i]
        slopes_at(0.0, stack, state.slopes)
        stroke = stack_stroke(command, state.slopes, plays, state.creep[i], stack) - param.neutral_stroke[i]
        frame[STROKE + i] = stroke
        state.strokes[i, :] = stroke
        state.target[i] = stroke
        frame[DESIRED_TIP + i] = 0.0
        state.command_V[i] = command
        state.on[i] = 0.0
    frame[CLIP] = 0
