"""Drives the PI E-727.3SDA digital piezo controller, three axes, over a serial line (GCS 2.0).

Source: PI manual E727T0005 (commands SVO, SVA, MOV, VOL?, TMN?, TMX?, ERR?).

A three-axis command is 30 to 36 bytes, about 3 ms at 115200 baud: the loop calls ``write`` every tick, the newest
values go out at ``rate_hz`` at most, and errors are asked for now and then without waiting for the answer.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np

from drivers.base import next_due_ns
from drivers.options import E727Options
from drivers.output_guard import GuardedOutput, OutputGuard
from drivers.piezo.e727_words import ASK_ERROR_EVERY, COMMANDS, DUE_NS, LATE, PERIOD_NS, SUPERSEDED, WORDS
from drivers.piezo.gcs import GcsLink
from drivers.registry import Driver, Load, Site, Traffic
from hal.arrays import Array
from hal.contracts import Clock, SerialPort
from hal.errors import BenchError, HalError, ProtocolError, WrongDevice
from hal.types import ChannelInfo, OutputLimit
from hal.wire_bits import serial_bits

CHANNELS = 3
RATE_MAX_HZ = 200.0
RAMP_STEPS = 11
"""Number of ramp steps (1 ms each). It leaves 9 of the 20 ms until neutral for the question where the outputs are."""
EPSILON_V = 1e-4  # four decimals are sent
COMMAND_BYTES = len("SVA 1 100.0000 2 100.0000 3 100.0000\n")
"""Longest command of ``write``: three digits before each decimal point. ``MOV`` is as long."""
ERROR_BYTES = len("ERR?\n")
"""Bytes that ``ask_error`` sends after every ``ASK_ERROR_EVERY`` commands; the answer travels on the other wire."""

UNSENT, SENT, ASKED = range(3)
"""How far the last step of a ramp is: not sent; taken by the port; followed by the question what was told."""


class E727(GuardedOutput):
    """Implements ``AnalogOutput`` for three stacks, in V at the stack.

    ``mode`` "open loop" sends SVA with volts. "servo" sends MOV with micrometres; ``um_per_V`` converts, so the
    firmware still computes in volts.
    """

    def __init__(
        self,
        port: SerialPort,
        clock: Clock,
        *,
        lo_V: float = 0.0,
        hi_V: float = 100.0,
        neutral_V: float = 50.0,
        slew_V_per_s: float = 20_000.0,
        rate_hz: float = 100.0,
        mode: Literal["open loop", "servo"] = "open loop",
        um_per_V: float = 0.15,
        name: str = "piezo",
    ) -> None:
        if not 0.0 < rate_hz <= RATE_MAX_HZ:
            raise BenchError(f"rate_hz = {rate_hz} is outside 0 .. {RATE_MAX_HZ:g} Hz", device=name)
        if not lo_V <= neutral_V <= hi_V:
            raise BenchError(f"neutral_V = {neutral_V} is outside {lo_V} .. {hi_V} V", device=name)
        self.name = name
        self.limits = (OutputLimit(lo_V, hi_V, slew_V_per_s, neutral_V),) * CHANNELS
        self.guard = OutputGuard(name, self.limits, clock, ramp_steps=RAMP_STEPS, longest_gap_s=1.5 / rate_hz)
        self.words = array("q", bytes(8 * WORDS))
        self.words[PERIOD_NS] = round(1e9 / rate_hz)
        self.port = port
        self.link = GcsLink(port, clock, name)
        self.servo = mode == "servo"
        self.per_V = um_per_V if self.servo else 1.0
        self._clock = clock
        self._verb = "MOV" if self.servo else "SVA"
        self._position_known = False
        self._neutral = UNSENT
        self._kernels: Any = None
        self._text = np.zeros(0, np.uint8)

    def probe(self) -> str:
        """Check identity, axes and limits, switch the servo as ``mode`` says, and return the identity. Raises
        ``WrongDevice``, or ``BenchError`` if the stage travels less than the limits allow."""
        self._load_kernels()  # from here on a ramp to neutral may be needed at once
        identity = self.link.query("*IDN?")[0]
        if "E-727" not in identity:
            raise WrongDevice(f"expected a PI E-727, found {identity!r}", device=self.name)
        axes = self.link.query("SAI?")
        if axes[:CHANNELS] != ["1", "2", "3"]:
            raise WrongDevice(f"axes 1, 2, 3 are needed, the controller has {axes}", device=self.name)
        self.link.clear_error()
        on = int(self.servo)
        self.link.command(f"SVO 1 {on} 2 {on} 3 {on}")
        if self.servo:
            low, high = self.link.values("TMN?", CHANNELS), self.link.values("TMX?", CHANNELS)
            limit = self.limits[0]
            if max(low) > limit.lo_V * self.per_V or min(high) < limit.hi_V * self.per_V:
                raise BenchError(
                    f"the stage travels {low} .. {high} um, less than lo_V .. hi_V command; narrow these",
                    device=self.name,
                )
        return identity

    def arming(self) -> Iterator[None]:
        """Ramp to neutral, ask for errors, and compare neutral with the set points that the controller reports."""
        if not self._position_known:
            self.probe()
        self._load_kernels()
        self._position_known, self._neutral = False, UNSENT
        while not self._ramp_step():  # what follows asks more than ``safe_step`` does
            yield
        self.link.settle()
        yield
        self.link.command(self._command().decode().rstrip())
        yield
        fault = self._fault_of_neutral(self.link.values(f"{self._verb}?", CHANNELS))
        self.guard.require(not fault, fault)
        self.guard.armed = True

    @property
    def commands(self) -> int:
        """Return the number of commands that the port has taken, in whole or in part."""
        return self.words[COMMANDS]

    @property
    def superseded(self) -> int:
        """Return the number of values that a newer one replaced before their command was due."""
        return self.words[SUPERSEDED]

    @property
    def late(self) -> int:
        """Return the number of values that were given up, because the line was slower than asked for."""
        return self.words[LATE]

    def write(self, values_V: Array) -> int:
        """Write ``values_V`` (3,) and return the mask, both as ``AnalogOutput.write`` says. Between two command times
        nothing is sent: the values are checked and ``superseded``. An error of the controller is raised some commands
        later."""
        self.link.take_error()
        now_ns = self._clock.now_ns()
        if now_ns < self.words[DUE_NS]:
            # still checked, so that a bad value trips in its own tick
            mask = self.guard.admit(values_V)
            self.words[SUPERSEDED] += 1
            return mask
        mask = self.guard.admit(values_V)
        self._begin_period(now_ns)
        if self._send():
            self.guard.sent()
        return mask

    def safe_step(self) -> bool:
        """Make one step of the ramp; after the last one ask the controller what it was told, and return True once it
        answers neutral: a line may hold back what the port has taken. That takes 7 ms at 115200 baud. Steps between two
        command times are not sent, except the last one. The first tick may have to ask where the outputs are, 8 ms: the
        ramp began before that.

        Another answer, and one that does not come, raise; the next call sends neutral anew."""
        if self._neutral == UNSENT:
            self._neutral = SENT if self._ramp_step() else UNSENT
            return False
        try:
            if self._neutral == SENT:
                self._neutral = ASKED if self.link.ask(f"{self._verb}?") else SENT
                return False
            answer = self.link.take_values(f"{self._verb}?", CHANNELS)
            if answer is None:
                return False
            if fault := self._fault_of_neutral(answer):
                raise ProtocolError(fault, device=self.name)
        except HalError:
            self._neutral = UNSENT
            self.link.forget_answer()
            raise
        self._neutral = UNSENT
        return True

    def _fault_of_neutral(self, answer: Sequence[float]) -> str:
        """Return why ``answer`` (3,), in the controller's unit, is not neutral; empty if it is."""
        values_V, neutral = [v / self.per_V for v in answer], [limit.safe_V for limit in self.limits]
        good = all(abs(a - b) < 0.01 for a, b in zip(values_V, neutral, strict=True))
        return "" if good else f"neutral is {neutral} V, the controller answers {values_V}"

    def _ramp_step(self) -> bool:
        """Make one step of the ramp. Return True when the port has taken the last one."""
        if not self._position_known:
            asked_ns = self._clock.now_ns()
            self.link.settle()  # else an answer to ``ERR?`` that is under way is taken for this one
            self.guard.start_from([v / self.per_V for v in self.link.values(f"{self._verb}?", CHANNELS)])
            self.guard.begin_ramp(asked_ns)
            self._position_known = True
        done = self.guard.ramp()
        now_ns = self._clock.now_ns()
        if done or now_ns >= self.words[DUE_NS]:
            self._begin_period(now_ns)
            if not self._send():
                return False
        self.guard.sent()
        return done

    def readback_V(self) -> Array:
        """Return the piezo voltages (3,) in V that the controller measures (``VOL?``)."""
        self.link.settle()
        return np.array(self.link.values("VOL? 1 2 3", CHANNELS))

    def close(self) -> None:
        """Ramp to neutral unless there, then close the port."""
        try:
            self.ramp_to_neutral()
        finally:
            self._position_known = False
            self.link.close()

    def _is_away(self) -> bool:
        """Return True while the outputs are not at neutral, as far as the controller has said."""
        return self._position_known and (self._neutral != UNSENT or not self.guard.at_safe_state())

    def channels(self) -> Sequence[ChannelInfo]:
        limit = self.limits[0]
        return [ChannelInfo(f"{self.name}.{i + 1}", "V", limit.lo_V, limit.hi_V, EPSILON_V) for i in range(CHANNELS)]

    def _load_kernels(self) -> None:
        if self._kernels is None:
            from drivers.piezo import e727_kernels  # numba: seconds, which a command that asks nothing does not pay

            self._kernels, self._text = e727_kernels, np.zeros(e727_kernels.TEXT_BYTES, np.uint8)
            e727_kernels.encode(self._text, False, np.zeros(CHANNELS), 1.0)

    def _begin_period(self, now_ns: int) -> None:
        self.words[DUE_NS] = next_due_ns(self.words[DUE_NS], now_ns, self.words[PERIOD_NS])

    def _command(self) -> bytes:
        self._load_kernels()
        n = self._kernels.encode(self._text, self.servo, np.array(self.guard.next_V), self.per_V)
        return self._text[:n].tobytes()

    def _send(self) -> bool:
        if not self.link.send(self._command()):
            self.words[LATE] += 1  # the line is slower than asked for: this value is given up
            return False
        self.words[COMMANDS] += 1
        if self.commands % ASK_ERROR_EVERY == 0:
            self.link.ask_error()
        return True


def _open(site: Site) -> E727:
    return E727(site.bench.serial(site.spec.bus or ""), site.bench.clock, name=site.name, **site.options.model_dump())


def _traffic(load: Load) -> Iterator[Traffic]:
    rate_hz = load.options.rate_hz
    yield Traffic("command", serial_bits(COMMAND_BYTES), rate_hz)
    yield Traffic("ERR?", serial_bits(ERROR_BYTES), rate_hz / ASK_ERROR_EVERY)


DRIVER = Driver(E727Options, _open, "output", traffic=_traffic, has_kernels=True)
