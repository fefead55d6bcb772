"""Wraps the firmware's amplifier beside a guardian: every command renews a lease, and none goes out after the guardian
has taken the outputs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from drivers.base import wait_s
from drivers.piezo.dac_output import DacOutput
from firmware_py.guardian.gate import LeaseGate
from firmware_py.guardian.heartbeat import Phase
from firmware_py.guardian.lifecycle import GuardianHandle
from hal.arrays import Array
from hal.contracts import ARMING_STEP_S, Clock
from hal.errors import SafetyTrip
from hal.types import OutputLimit

RETURN_LIMIT_NS = 200_000_000
"""Time limit for the guardian to return the outputs at neutral, where it first checks them for 50 ms (``HOLD_NS``)."""
ALIVE_NS = 10_000_000
"""Time for which a sign of life of the guardian counts; it gives one every millisecond."""
STEP_S = 0.001
RAMP_AFTER_BUS_NS = 60_000_000
"""Time limit for the guardian's ramp after the bus works again. The guardian may retry up to 10 ms later, and others
use the bus as well."""
READ_INTERVAL_NS = 4_000_000
"""Time between two read-backs near the end of ``GUARDIAN_RAMP_NS``. Outputs that differ between them are being ramped
by the guardian."""
SLOW_READ_NS = 5_000_000
"""Duration above which a read-back had to wait for the bus."""
GUARDIAN_RAMP_NS = 22_000_000
"""Time limit for the guardian's ramp; after it the firmware ends the guardian and ramps itself."""


class GuardedAmplifier:
    """Implements ``AnalogOutput`` around ``inner``. It is armed only while the guardian of ``handle`` lives, and each
    command renews a lease of ``lease_ms``."""

    def __init__(self, inner: DacOutput, handle: GuardianHandle, clock: Clock, *, lease_ms: float) -> None:
        heartbeat = handle.heartbeat
        self.name = inner.name
        self.limits: tuple[OutputLimit, ...] = inner.limits
        self.inner = inner
        self._heartbeat = heartbeat
        self._clock = clock
        self._handle = handle
        self.gate = LeaseGate(heartbeat, clock, inner.name, lease_ms)
        self._lost_ns = 0
        self._has_requested = False
        self._bus_fails = False
        self._codes: list[int] | None = None
        inner.gate = self.gate

    @property
    def commanded_V(self) -> Sequence[float]:
        return self.inner.commanded_V

    def arm(self) -> None:
        """Do the steps of ``arming`` one after another."""
        for _ in self.arming():
            wait_s(self._clock, ARMING_STEP_S)

    def arming(self) -> Iterator[None]:
        """Arm ``inner`` once a guardian watches and the outputs are the firmware's.

        Raises ``SafetyTrip`` if no guardian gives a sign of life within ``RETURN_LIMIT_NS``, or if the guardian has the
        outputs and does not return them within that time."""
        yield from self._require_guardian()
        yield from self._await_outputs()
        self._heartbeat.set_phase(Phase.ARMING)
        yield from self.inner.arming()
        self._heartbeat.beat(self._clock.now_ns())
        self._heartbeat.set_phase(Phase.RUNNING)

    @property
    def commands_sent(self) -> int:
        return self.inner.commands_sent

    def write(self, values_V: Array) -> int:
        """Write as ``AnalogOutput.write`` does, and return its mask. Raises ``LeaseLost`` if the guardian has the
        outputs or the lease has expired; nothing is sent then."""
        return self.inner.write(values_V)

    def safe_step(self) -> bool:
        """Make one step of the ramp, or wait for the guardian's ramp. Return True once neutral is read back."""
        self._accept_outputs()
        if (self.gate.lost or self._heartbeat.taken_ns) and not self._regain_outputs():
            return self._has_requested
        done = self.inner.safe_step()
        if done:
            self._heartbeat.set_phase(Phase.IDLE)
        return done

    def readback_V(self) -> Array:
        return self.inner.readback_V()

    def close(self) -> None:
        """Take the outputs to neutral unless they are there. Raises ``HalError`` if neutral cannot be confirmed; the
        guardian then goes on trying."""
        while self.gate.lost or self._heartbeat.taken_ns:
            if self._regain_outputs():
                self.inner.safe_step()
            elif self._has_requested:
                break  # the guardian has read neutral back
            else:
                wait_s(self._clock, STEP_S)
        self.inner.close()
        self._heartbeat.set_phase(Phase.IDLE)

    def _require_guardian(self) -> Iterator[None]:
        """Wait until the guardian gives a sign of life; a recent one counts. Raises ``SafetyTrip`` if none comes."""
        heartbeat, begin_ns = self._heartbeat, self._clock.now_ns()
        seen_ns, now_ns = heartbeat.guardian_alive_ns, begin_ns
        while self._handle.is_alive() and now_ns - begin_ns <= RETURN_LIMIT_NS:
            if heartbeat.guardian_alive_ns != seen_ns or 0 < seen_ns >= now_ns - ALIVE_NS:
                self.gate.require_lease()
                return
            yield
            now_ns = self._clock.now_ns()
        raise SafetyTrip(
            "the outputs are not armed, because no guardian watches over them; start the run again", device=self.name
        )

    def _await_outputs(self) -> Iterator[None]:
        """Wait until the guardian has returned the outputs after a hold. Raises ``SafetyTrip`` if it does not."""
        heartbeat = self._heartbeat
        limit_ns = self._clock.now_ns() + RETURN_LIMIT_NS
        while heartbeat.taken_ns:
            if self._clock.now_ns() > limit_ns:
                raise SafetyTrip("the guardian does not give the outputs back; start the run again", device=self.name)
            yield
        self._accept_outputs()

    def _accept_outputs(self) -> None:
        if self._has_requested and not self._heartbeat.taken_ns:
            self._has_requested, self._lost_ns, self._codes = False, 0, None
            self.gate.clear_loss()

    def _regain_outputs(self) -> bool:
        """Take the outputs back from a guardian that has not reached neutral in time: kill it and return True, so that
        this process ramps them. If the guardian has reached neutral, ask for the outputs and return False; if it is
        still at work, return False."""
        heartbeat, now_ns = self._heartbeat, self._clock.now_ns()
        # a command that was under way may have moved the outputs from neutral after the guardian had reached it
        if heartbeat.neutral_ns and heartbeat.confirmed_ns >= self.gate.transfer_end_ns:
            self.inner.guard.brought_to_safe_state()
            self.inner.lose_position()
            heartbeat.request_outputs(now_ns)  # before IDLE: a guardian that sees IDLE without a request ends
            heartbeat.set_phase(Phase.IDLE)
            self._has_requested = True
            return False
        self.gate.lost = True
        heartbeat.set_phase(Phase.YIELDED)
        self._lost_ns = self._lost_ns or now_ns
        if self._handle.is_alive() and self._is_guardian_at_work(now_ns):
            return False  # two ramps at once would command jumps
        self._handle.kill()
        heartbeat.clear_guardian()
        self.gate.drop_lease()
        self._lost_ns, self._codes = 0, None
        self.inner.lose_position()
        return True

    def _is_guardian_at_work(self, now_ns: int) -> bool:
        """Return True while the guardian's time is not over, the outputs move, or the bus has only just recovered.

        Raises ``HalError`` if the amplifier does not answer: then the bus fails, not the guardian.
        """
        waited_ns = now_ns - self._lost_ns
        if waited_ns < GUARDIAN_RAMP_NS - (READ_INTERVAL_NS if self._codes is None else 0):
            return True
        before, failed = self._codes, self._bus_fails
        self._codes, self._bus_fails = None, True
        codes = self.inner.read_codes()
        read_ns = self._clock.now_ns()
        self._codes, self._bus_fails = codes, False
        if failed or read_ns - now_ns > SLOW_READ_NS:
            self._lost_ns = read_ns + RAMP_AFTER_BUS_NS - GUARDIAN_RAMP_NS
        elif before is not None and codes != before:
            self._lost_ns = read_ns - GUARDIAN_RAMP_NS + READ_INTERVAL_NS
        return before is None or read_ns - self._lost_ns < GUARDIAN_RAMP_NS
