"""The amplifier as the firmware sees it beside a guardian: every command is a heartbeat, and none goes out after the
guardian has taken the outputs."""

from __future__ import annotations

from drivers.piezo.dac_amplifier import DacAmplifier
from firmware_py.guardian.heart import Heart, Phase
from hal.contracts import Clock, Float64Array
from hal.errors import SafetyTrip
from hal.types import OutputLimit

PATIENCE_NS = 40_000_000
"""So long the guardian may take for its ramp before the firmware does it itself."""


class GuardedAmplifier:
    """AnalogOutput around ``inner``."""

    def __init__(self, inner: DacAmplifier, heart: Heart, clock: Clock) -> None:
        self.name = inner.name
        self.limits: tuple[OutputLimit, ...] = inner.limits
        self._inner = inner
        self._heart = heart
        self._clock = clock
        self._yielded = False

    def arm(self) -> None:
        self._heart.say(Phase.ARMING)
        self._inner.arm()
        self._heart.beat(self._clock.now_ns())
        self._heart.say(Phase.RUNNING)

    def write(self, values_V: Float64Array) -> int:
        """Raises ``SafetyTrip`` when the guardian has the outputs."""
        heart, now_ns = self._heart, self._clock.now_ns()
        if heart.taken_ns:
            stood_ms = (heart.taken_ns - heart.beat_ns) * 1e-6
            raise SafetyTrip(
                f"the host stood still for {stood_ms:.0f} ms, so the guardian has taken the outputs to neutral",
                device=self.name,
            )
        heart.beat(now_ns)
        return self._inner.write(values_V)

    def safe_step(self) -> bool:
        heart, now_ns = self._heart, self._clock.now_ns()
        if heart.taken_ns and not self._yielded:
            if not heart.reached_ns and now_ns - heart.taken_ns < PATIENCE_NS:
                return False  # two ramps at once would not be one
            self._inner.lose_position()
            self._yielded = True
        heart.beat(now_ns)
        done = self._inner.safe_step()
        if done:
            heart.say(Phase.IDLE)
        return done

    def readback_V(self) -> Float64Array:
        return self._inner.readback_V()

    def close(self) -> None:
        if self._heart.taken_ns and not self._yielded:
            self._inner.lose_position()
            self._yielded = True
        self._inner.close()  # where this fails, the guardian goes on trying
        self._heart.say(Phase.IDLE)
