"""Decides whether the actuators may move: the supervisor is one state machine.

Outputs are armed only after the self-test. Whatever goes wrong, the amplifier ramps to neutral (``ramp_ticks_at``).
After a latched finding it stays there, and the first reason wins. After a recoverable one it holds there until
``Holds`` lets it resume::

    RUNNING -> HOLD_RAMP -> HOLD -> RUNNING        any of them -> SAFE_RAMP -> SAFE
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated, Literal

from pydantic import Field, field_validator

from firmware_py.run.findings import CauseClass, Finding
from hal.contracts import AnalogOutput, ArmsInSteps
from hal.errors import HalError, I2cNack
from hal.validation import StrictTable

RAMP_TICKS = 20
"""Ticks from the decision to neutral, 20 ms at 1 kHz. The driver's ramp is shorter (``drivers.output_guard_steps``:
``RAMP_STEPS`` of 1 ms each), so that steps can be retried."""
RAMP_NS = 20_000_000
"""Least time from the decision to neutral that an amplifier has, at any tick rate."""
ATTEMPTS = 3
"""Largest number of attempts at a ramp step within one tick. A refusal (NACK) takes a tenth of a transfer's time."""


class State(IntEnum):
    """Names what the outputs may do. The numbers go into telemetry and recordings."""

    BOOT = 0
    SELF_TEST = 1
    RUNNING = 2
    SAFE_RAMP = 3
    SAFE = 4
    SENSING_ONLY = 5
    HOLD_RAMP = 6
    HOLD = 7

    @property
    def words(self) -> str:
        """Return the state's name for display. The ramp of a hold counts as part of the hold."""
        return "hold" if self is State.HOLD_RAMP else self.name.lower().replace("_", " ")


Time_ms = Annotated[float, Field(ge=1.0, le=10_000.0)]
Temperature_C = Annotated[float, Field(ge=-100.0, le=200.0)]
Supply_V = Annotated[float, Field(ge=0.0, le=10.0)]


class SafetyLimits(StrictTable):
    """Sets the limits beyond which the outputs leave normal operation: ``[firmware.safety]``. Times are bench time.

    ``stale_ms``: longest time without a scan. ``temperature_C`` and ``supply_V``: lowest and highest reading.
    ``saturated_ms``: longest time for which an axis may stay at its limit.
    ``stalled_ms``: scans that come at once after this time say that the host stood still without control.
    ``magnetometer_ms``: longest time without a field; a heading that is integrated from accelerations drifts.
    ``monitor_ms``: longest time without a reading of the amplifier's monitor.
    ``guardian``: a second process takes the outputs to neutral when this one dies, or sends no command for
    ``guardian_ms``, or for twice ``stale_ms`` if that is longer; it notes a pause of ``guardian_notice_ms``.
    ``neutral_retry_s``: time for which firmware and guardian retry a ramp over a bus that fails; then they give up.
    ``hold_ms``: time for which scans and self-test must have been good without interruption after a recoverable
    finding before the outputs move again. ``hold_limit_ms``: a hold that has not become good in this time ends the run.
    ``holds_per_minute``: number of holds allowed within a minute; one more ends the run, and with 0 every finding does.
    ``rearm``: who ends a hold whose cause has passed, the firmware or a person (button of the page, key, SIGUSR1).
    """

    stale_ms: Time_ms = 5.0
    temperature_C: tuple[Temperature_C, Temperature_C] = (0.0, 60.0)
    supply_V: tuple[Supply_V, Supply_V] = (4.5, 5.5)
    saturated_ms: Time_ms = 50.0
    stalled_ms: Time_ms = 100.0
    magnetometer_ms: Time_ms = 150.0
    monitor_ms: Time_ms = 100.0
    guardian: bool = True
    guardian_notice_ms: float = Field(default=8.0, ge=1.0, le=1000.0)
    guardian_ms: float = Field(default=40.0, ge=2.0, le=1000.0)
    neutral_retry_s: float = Field(default=10.0, ge=0.1, le=600.0)
    hold_ms: float = Field(default=200.0, ge=20.0, le=60_000.0)
    hold_limit_ms: float = Field(default=3000.0, ge=100.0, le=600_000.0)
    holds_per_minute: int = Field(default=3, ge=0, le=1000)
    rearm: Literal["automatic", "operator"] = "automatic"

    @field_validator("temperature_C", "supply_V")
    @classmethod
    def _check_order(cls, limits: tuple[float, float]) -> tuple[float, float]:
        if limits[0] >= limits[1]:
            raise ValueError(f"the lower limit {limits[0]:g} is not below the upper limit {limits[1]:g}")
        return limits


class SelfTestLimits(StrictTable):
    """Sets how long the sensors must be good without interruption before arming, and the time limit of the self-test.

    ``watch_ms``: required time without interruption. ``limit_ms``: a self-test that takes longer trips.
    """

    watch_ms: float = Field(default=500.0, ge=50.0, le=10_000.0)
    limit_ms: float = Field(default=3000.0, ge=100.0, le=60_000.0)


@dataclass(frozen=True)
class Trip:
    """Records why and when the outputs were taken to their safe state. ``tick``: number of the tick under way;
    ``t_ns``: time of the decision (bench clock); ``cause``: class of the cause."""

    finding: Finding
    reason: str
    tick: int
    t_ns: int
    cause: CauseClass

    @property
    def normal(self) -> bool:
        """True for the end of an ordinary run."""
        return self.finding.value.normal


@dataclass
class Hold:
    """Records one hold. ``t_ns``: time of the decision, bench clock; ``end_ns``: time at which the outputs could move
    again or the run ended, ``None`` while the hold lasts. ``neutral_ns``: time at which neutral was reached."""

    finding: Finding
    reason: str
    tick: int
    t_ns: int
    cause: CauseClass
    end_ns: int | None = None
    resumed: bool = False
    neutral_ns: int | None = None


def ramp_ticks_at(period_ns: int) -> int:
    """Return ``RAMP_TICKS``, or the ticks of 20 ms where a tick is shorter than 1 ms: a wire takes its time."""
    return max(RAMP_TICKS, -(-RAMP_NS // period_ns))


class Supervisor:
    """Owns the permission to move. It arms and ramps ``output`` and uses no other device; an instrument without outputs
    (``None``) is at neutral at once."""

    def __init__(self, output: AnalogOutput | None, ramp_ticks: int = RAMP_TICKS) -> None:
        self._output = output
        self.ramp_ticks = ramp_ticks
        """Ticks within which the ramp is expected to end; it is retried after twice as many."""
        self._ramp_ticks = 0
        self.state = State.BOOT
        self.trip_cause: Trip | None = None
        self.safe_reached = False
        self.ramp_failure = ""
        self.was_late = False
        """True if neutral was reached only by retries after the ramp's time was over."""
        self.holds: list[Hold] = []
        self.warnings: dict[str, int] = {"jerk": 0, "drift": 0}
        """Counts how often each warning was reported. The run's report shows it beside the reason of the run's end."""

    @property
    def may_move(self) -> bool:
        """True while commands may be sent. Nothing else lets a command through."""
        return self.state is State.RUNNING

    @property
    def is_safe(self) -> bool:
        """True once the run is over: neutral was reached or had to be given up."""
        return self.state is State.SAFE

    @property
    def must_not_wait(self) -> bool:
        """True if the ramp must run on the host clock: the loop would wait for scans, and they may be what broke. Only
        the planned end of a run waits for scans, so that it is recorded to its last step."""
        trip = self.trip_cause
        if self.state is not State.SAFE_RAMP or trip is None:
            return False
        return trip.finding is not Finding.FINISHED or self.is_retrying

    @property
    def is_retrying(self) -> bool:
        """True while a ramp that failed within its time is retried, until it succeeds or is given up."""
        return self.state is State.SAFE_RAMP and self._ramp_ticks >= 2 * self.ramp_ticks

    @property
    def is_holding(self) -> bool:
        """True during a hold, on the way to neutral and at neutral."""
        return self.state in (State.HOLD_RAMP, State.HOLD)

    @property
    def is_active(self) -> bool:
        """True from the self-test to the end of the run, also in a hold; never where nothing is armed."""
        return self.may_move or self.is_holding or self.state is State.SELF_TEST

    def begin_self_test(self) -> None:
        if self.state is State.BOOT:
            self.state = State.SELF_TEST

    def begin_sensing(self) -> None:
        """Begin a run that senses and never arms, for poses by hand and for sensors that are not calibrated yet."""
        if self.state is State.BOOT:
            self.state = State.SENSING_ONLY

    def arm(self, meanwhile: Callable[[], object] | None = None) -> None:
        """Arm the output (it tests itself) and allow motion. Nothing is armed after a trip. ``meanwhile`` lets the time
        after each step of ``ArmsInSteps`` pass."""
        if self.state is State.SELF_TEST:
            self._arm_output(meanwhile)

    def hold(self, finding: Finding, reason: str, *, tick: int, t_ns: int) -> None:
        """Begin a ramp to neutral from which the run can resume. Has no effect unless the state is RUNNING."""
        if self.state is State.RUNNING:
            self.holds.append(Hold(finding, reason, tick, t_ns, finding.value.cause))
            self._ramp_ticks = 0
            self.state = State.HOLD_RAMP
            if self._output is None:
                self.holds[-1].neutral_ns = t_ns
                self.step()

    def resume(self, meanwhile: Callable[[], object] | None = None) -> None:
        """Arm the output again (it reads neutral back) and allow motion. If arming raises, the hold continues.
        ``meanwhile``: see ``arm``."""
        if self.state is State.HOLD:
            self._arm_output(meanwhile)

    def _arm_output(self, meanwhile: Callable[[], object] | None) -> None:
        output, state = self._output, self.state
        if meanwhile is not None and isinstance(output, ArmsInSteps):
            for _ in output.arming():
                meanwhile()
                if self.state is not state:  # a finding has changed the state meanwhile
                    return
        elif output is not None:
            output.arm()
        self.state = State.RUNNING

    def trip(self, finding: Finding, reason: str, *, tick: int, t_ns: int, cause: CauseClass | None = None) -> None:
        """Decide for the safe state; later reasons do not replace the first. ``cause`` replaces the finding's own class
        of cause when a hold leads to the end of the run."""
        if self.trip_cause is not None:
            return
        self.trip_cause = Trip(finding, reason, tick, t_ns, finding.value.cause if cause is None else cause)
        if self.is_holding:
            self.holds[-1].end_ns = t_ns
        if self.state is not State.HOLD_RAMP:  # a ramp that is under way keeps its time
            self._ramp_ticks = 0
        self.state = State.SAFE_RAMP
        if self._output is None:
            self.step()

    def warn(self, what: str) -> None:
        """Count a warning ``what``, which does not end the run."""
        self.warnings[what] = self.warnings.get(what, 0) + 1

    def step(self, *, may_retry: bool = False) -> bool:
        """Run one tick of the ramp. Return True in the safe state: neutral was reached or had to be given up.

        A transfer that is refused is tried again at once, one that fails otherwise on the next tick. When twice the
        ramp's time is over, a hold becomes the end of the run; the ramp is given up unless it ``may_retry``. Then the
        report says that neutral could not be confirmed, and why.
        """
        if self.state not in (State.SAFE_RAMP, State.HOLD_RAMP):
            return self.state is State.SAFE
        self._ramp_ticks += 1
        at_neutral = False
        for _ in range(ATTEMPTS):
            try:
                at_neutral = self._output is None or self._output.safe_step()
            except HalError as error:
                self.ramp_failure = str(error)
                if isinstance(error, I2cNack):
                    continue
            break
        if at_neutral:
            self.ramp_failure = ""
            self.was_late = self.is_retrying
            self.safe_reached = self.state is State.SAFE_RAMP
            self.state = State.SAFE if self.safe_reached else State.HOLD
        elif self._ramp_ticks >= 2 * self.ramp_ticks:
            self._handle_late_ramp(may_retry)
        return self.state is State.SAFE

    def _handle_late_ramp(self, may_retry: bool) -> None:
        """Handle a ramp that did not confirm neutral in time. A hold needs neutral, so its reason ends the run."""
        self.ramp_failure = self.ramp_failure or "the amplifier did not report neutral in time"
        if self.state is State.HOLD_RAMP:
            hold = self.holds[-1]
            self.trip(Finding.NEUTRAL_NOT_REACHED, hold.reason, tick=hold.tick, t_ns=hold.t_ns, cause=hold.cause)
        self.state = State.SAFE_RAMP if may_retry else State.SAFE
