"""The supervisor: one state machine that decides whether the actuators may move.

Outputs are armed only after the self-test. Whatever goes wrong, the first reason wins, the amplifier ramps to
neutral within ``RAMP_TICKS``, and stays there: there is no way back to RUNNING in one run.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from pydantic import BaseModel, ConfigDict

from hal.contracts import AnalogOutput
from hal.errors import HalError, I2cNack

RAMP_TICKS = 20
"""Neutral within 20 ms of the decision; the amplifier's ramp is shorter, so that steps can be tried again."""
ATTEMPTS = 3
"""Of a step that nobody acknowledged, within its tick: a refusal takes a tenth of the time of a transfer."""
FINISHED = "run finished"


class State(IntEnum):
    """What the outputs may do. The numbers go into telemetry and recordings."""

    BOOT = 0
    SELF_TEST = 1
    RUNNING = 2
    SAFE_RAMP = 3
    SAFE = 4
    SENSING_ONLY = 5


class SafetyLimits(BaseModel):
    """When data count as stale, what is too hot, how long an axis may sit at its limit.

    ``stalled_ms``: scans that come in one piece after so long say that the host stood still, uncontrolled.
    ``magnetometer_ms``: how long the heading may coast; a rate that is integrated from accelerations does not keep it
    for longer.
    ``monitor_ms``: how long the amplifier's monitor may be deaf.
    ``guardian``: a second process takes the outputs to neutral when this one dies, or gives no command for
    ``guardian_ms``; it notices a pause of ``guardian_notice_ms``.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    stale_ms: float = 5.0
    temperature_C: tuple[float, float] = (0.0, 60.0)
    supply_V: tuple[float, float] = (4.5, 5.5)
    saturated_ms: float = 50.0
    stalled_ms: float = 100.0
    magnetometer_ms: float = 150.0
    monitor_ms: float = 100.0
    guardian: bool = True
    guardian_notice_ms: float = 8.0
    guardian_ms: float = 40.0


@dataclass(frozen=True)
class Trip:
    """Why and when the outputs were taken to their safe state; ``normal`` for the end of an ordinary run."""

    reason: str
    tick: int
    t_ns: int
    normal: bool = False


class Supervisor:
    """Owns the permission to move. ``amplifier`` is the only thing it touches."""

    def __init__(self, amplifier: AnalogOutput) -> None:
        self._amplifier = amplifier
        self._ramp_ticks = 0
        self.state = State.BOOT
        self.trip_cause: Trip | None = None
        self.safe_reached = False
        self.ramp_failure = ""
        self.warnings: dict[str, int] = {"jerk": 0, "drift": 0}
        """How often each was reported: what the run's report shows beside the reason of its end."""

    @property
    def may_move(self) -> bool:
        """Only this lets a command through."""
        return self.state is State.RUNNING

    @property
    def must_not_wait(self) -> bool:
        """A ramp that somebody or something asked for runs on the host clock: the loop would wait for scans, and they
        may be what broke. Only the planned end of a run is recorded to its last step."""
        return self.state is State.SAFE_RAMP and self.trip_cause is not None and self.trip_cause.reason != FINISHED

    def begin_self_test(self) -> None:
        if self.state is State.BOOT:
            self.state = State.SELF_TEST

    def begin_sensing(self) -> None:
        """A run that looks and never arms: for poses by hand, for sensors that nobody has calibrated yet."""
        if self.state is State.BOOT:
            self.state = State.SENSING_ONLY

    def arm(self) -> None:
        """Arm the amplifier (it tests itself) and allow motion. Nothing is armed after a trip."""
        if self.state is State.SELF_TEST:
            self._amplifier.arm()
            self.state = State.RUNNING

    def trip(self, reason: str, *, tick: int, t_ns: int, normal: bool = False) -> None:
        """Decide for the safe state; later reasons do not replace the first."""
        if self.trip_cause is None:
            self.trip_cause = Trip(reason, tick, t_ns, normal)
            self.state = State.SAFE_RAMP

    def warn(self, what: str) -> None:
        """Something is not as it should be and does not end the run."""
        self.warnings[what] = self.warnings.get(what, 0) + 1

    def step(self) -> bool:
        """One tick of the ramp; True once neutral is reached or has to be given up.

        A transfer that is refused is tried again at once, one that fails otherwise on the next tick, until twice the
        ramp's time is over; then the report says that neutral could not be confirmed, and why.
        """
        if self.state is not State.SAFE_RAMP:
            return self.state is State.SAFE
        self._ramp_ticks += 1
        for _ in range(ATTEMPTS):
            try:
                if self._amplifier.safe_step():
                    self.state, self.safe_reached, self.ramp_failure = State.SAFE, True, ""
            except HalError as error:
                self.ramp_failure = str(error)
                if isinstance(error, I2cNack):
                    continue
            break
        if self.state is State.SAFE_RAMP and self._ramp_ticks >= 2 * RAMP_TICKS:
            self.state = State.SAFE
            self.ramp_failure = self.ramp_failure or "the amplifier did not report neutral in time"
        return self.state is State.SAFE
