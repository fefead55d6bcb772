"""The amplifier as the firmware sees it beside a guardian: every command renews a lease, and none goes out after the
guardian has taken the outputs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from drivers.base import wait_s
from drivers.piezo.dac_output import DacOutput
from firmware_py.guardian.care import Keeper
from firmware_py.guardian.gate import LeaseGate
from firmware_py.guardian.heart import Phase
from hal.arrays import Array
from hal.contracts import ARMING_STEP_S, Clock
from hal.errors import SafetyTrip
from hal.types import OutputLimit

GIVE_BACK_NS = 200_000_000
"""Time limit for the guardian to give the outputs back at neutral; it watches over them for 50 ms of it."""
FRESH_NS = 10_000_000
"""A sign of life of the guardian, which gives one every millisecond, counts for so long."""
STEP_S = 0.001
BACK_NS = 60_000_000
"""Time limit for the guardian's ramp after the bus has come back. Its next try comes up to 10 ms later, over a bus on
which others wait as well."""
LOOK_NS = 4_000_000
"""Time between two looks at the outputs at the end of the guardian's time. Outputs that move are its ramp."""
SLOW_NS = 5_000_000
"""A read-back that takes longer had to wait for the bus."""
PATIENCE_NS = 22_000_000
"""Time limit for the guardian's ramp; after it the firmware ends the guardian and ramps itself."""


class GuardedAmplifier:
    """AnalogOutput around ``inner``, armed only while the guardian of ``keeper`` lives."""

    def __init__(self, inner: DacOutput, keeper: Keeper, clock: Clock, *, lease_ms: float) -> None:
        heart = keeper.heart
        self.name = inner.name
        self.limits: tuple[OutputLimit, ...] = inner.limits
        self.inner = inner
        self._heart = heart
        self._clock = clock
        self._keeper = keeper
        self.gate = LeaseGate(heart, clock, inner.name, lease_ms)
        self._lost_ns = 0
        self._asked = False
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
        """Raises ``SafetyTrip`` when nobody would take the outputs to neutral if this process died, or when they are
        the guardian's and it does not give them back."""
        yield from self._require_guardian()
        yield from self._take_up_again()
        self._heart.say(Phase.ARMING)
        yield from self.inner.arming()
        self._heart.beat(self._clock.now_ns())
        self._heart.say(Phase.RUNNING)

    @property
    def commands_sent(self) -> int:
        return self.inner.commands_sent

    def write(self, values_V: Array) -> int:
        """Raises ``LeaseLost`` when the guardian has the outputs, or will have them because the lease is over."""
        return self.inner.write(values_V)

    def safe_step(self) -> bool:
        self._take_up_if_given_back()
        if (self.gate.lost or self._heart.taken_ns) and not self._is_ours_again():
            return self._asked
        done = self.inner.safe_step()
        if done:
            self._heart.say(Phase.IDLE)
        return done

    def readback_V(self) -> Array:
        return self.inner.readback_V()

    def close(self) -> None:
        """Bring the outputs to neutral unless they are there. Raises ``HalError`` when that cannot be confirmed; the
        guardian is not ended then, and goes on trying."""
        while self.gate.lost or self._heart.taken_ns:
            if self._is_ours_again():
                self.inner.safe_step()
            elif self._asked:
                break  # the guardian has read neutral back
            else:
                wait_s(self._clock, STEP_S)
        self.inner.close()
        self._heart.say(Phase.IDLE)

    def _require_guardian(self) -> Iterator[None]:
        """The guardian lives, and has given a sign of life just now or gives one soon."""
        heart, begin_ns = self._heart, self._clock.now_ns()
        seen_ns, now_ns = heart.watched_ns, begin_ns
        while self._keeper.is_alive() and now_ns - begin_ns <= GIVE_BACK_NS:
            if heart.watched_ns != seen_ns or 0 < seen_ns >= now_ns - FRESH_NS:
                self.gate.join()
                return
            yield
            now_ns = self._clock.now_ns()
        raise SafetyTrip(
            "the outputs are not armed, because no guardian watches over them; start the run again", device=self.name
        )

    def _take_up_again(self) -> Iterator[None]:
        """After a hold: the guardian must have given the outputs back."""
        heart = self._heart
        limit_ns = self._clock.now_ns() + GIVE_BACK_NS
        while heart.taken_ns:
            if self._clock.now_ns() > limit_ns:
                raise SafetyTrip("the guardian does not give the outputs back; start the run again", device=self.name)
            yield
        self._take_up_if_given_back()

    def _take_up_if_given_back(self) -> None:
        if self._asked and not self._heart.taken_ns:
            self._asked, self._lost_ns, self._codes = False, 0, None
            self.gate.take_up()

    def _is_ours_again(self) -> bool:
        """After the guardian has taken the outputs: only when it has not reached neutral in time and is gone."""
        heart, now_ns = self._heart, self._clock.now_ns()
        # a command that was under way may have moved the outputs from neutral after the guardian had reached it
        if heart.reached_ns and heart.confirmed_ns >= self.gate.left_ns:
            self.inner.guard.brought_to_safe_state()
            self.inner.lose_position()
            heart.ask_back(now_ns)  # before IDLE: a guardian that sees IDLE without a wish takes its leave
            heart.say(Phase.IDLE)
            self._asked = True
            return False
        self.gate.lost = True
        heart.say(Phase.YIELDED)
        self._lost_ns = self._lost_ns or now_ns
        if self._keeper.is_alive() and self._is_guardian_at_work(now_ns):
            return False  # two ramps at once would not be one
        self._keeper.evict()
        heart.forget_guardian()
        self.gate.regain()
        self._lost_ns, self._codes = 0, None
        self.inner.lose_position()
        return True

    def _is_guardian_at_work(self, now_ns: int) -> bool:
        """The guardian's time is not over yet, or the outputs move, or the bus has only just come back.

        Raises ``HalError`` when the amplifier does not answer: then the bus fails, not the guardian.
        """
        waited_ns = now_ns - self._lost_ns
        if waited_ns < PATIENCE_NS - LOOK_NS or (waited_ns < PATIENCE_NS and self._codes is not None):
            return True
        before, failed = self._codes, self._bus_fails
        self._codes, self._bus_fails = None, True
        codes = self.inner.read_codes()
        read_ns = self._clock.now_ns()
        self._codes, self._bus_fails = codes, False
        if failed or read_ns - now_ns > SLOW_NS:
            self._lost_ns = read_ns + BACK_NS - PATIENCE_NS
        elif before is not None and codes != before:
            self._lost_ns = read_ns - PATIENCE_NS + LOOK_NS
        return before is None or read_ns - self._lost_ns < PATIENCE_NS
