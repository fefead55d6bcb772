"""Three-channel piezo amplifier behind an AD5696R: 16-bit quad I2C DAC, internal 2.5 V reference, gain pin high.

Source: Analog Devices AD5696R data sheet rev. B: "Input shift register" (Tables 7 and 8), "Write operation",
"Multiple DAC readback sequence", "Load DAC", "Internal reference setup". V_DAC = 2.5 V * 2 * code / 65536.

One transfer per update: A, B, C into the input registers, then one update command, so that all outputs move at
once. Segments are separated by repeated STARTs, because the data sheet knows one 24-bit word per address byte.
The DAC has no watchdog: the safe state is the firmware's duty.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from drivers.base import wait_s
from hal.contracts import Clock, Float64Array, I2cBus
from hal.errors import BenchError, HalError, ProtocolError, WrongDevice
from hal.output_guard import OutputGuard
from hal.types import ChannelInfo, I2cOp, I2cRead, I2cWrite, OutputLimit
from hal.wire_bits import i2c_bits

CHANNELS = 3
WRITE_INPUT, UPDATE, POWER, LDAC_MASK, REFERENCE = 0x10, 0x20, 0x40, 0x50, 0x70
ADDRESS_BITS = (0x1, 0x2, 0x4)  # DAC A, B, C
SPARE = 0x8  # DAC D, not connected
PATTERNS = (0x5AA5, 0x0000, 0xA55A)  # into DAC D; the last one stays there and is neither end nor middle of the scale
DAC_SPAN_V = 5.0
CODES = 65536
RAMP_TICK_S = 0.001
MAX_BUS_HZ = 400_000  # data sheet, table 4: SCL frequency
_COMMAND: tuple[I2cOp, ...] = (I2cWrite(bytes(3)),) * (CHANNELS + 1)
_READ_BACK: tuple[I2cOp, ...] = (I2cWrite(bytes(1)), I2cRead(2 * CHANNELS))
_VERIFY: tuple[I2cOp, ...] = (I2cWrite(bytes(1)), I2cRead(2 * (CHANNELS + 1)))
WIRE_BITS = {
    "command": i2c_bits(_COMMAND),
    "command with read-back": i2c_bits(_COMMAND + _READ_BACK),
    "verify": i2c_bits(_VERIFY),
}
"""Bits of what the loop repeats: ``write`` without and with ``read_back``, and ``verify``. Retries are left out."""
READ_BACK_NS = 200_000  # pointer and six bytes at 400 kHz: the update has been in force for at least so long
TRANSFER_NS = 365_000  # 4 segments of 4 bytes at 400 kHz, the fastest that the part allows, less a bit each


class OutputGate(Protocol):
    """Asked immediately before every transfer that moves outputs, told when it is over."""

    def enter(self, codes: tuple[int, int, int]) -> None:
        """May raise: then nothing is sent."""
        ...

    def leave(self) -> None: ...


class DacAmplifier:
    """AnalogOutput of three stacks, in V at the stack. ``arm`` -> ``write`` ... -> ``safe_step``."""

    def __init__(
        self,
        bus: I2cBus,
        clock: Clock,
        address: int = 0x0C,
        *,
        gain: float = 20.0,
        lo_V: float = 0.0,
        hi_V: float = 100.0,
        neutral_V: float = 50.0,
        slew_V_per_s: float = 20_000.0,
        read_back: bool = False,
        name: str = "piezo",
    ) -> None:
        full_V = DAC_SPAN_V * gain
        if not 0x0C <= address <= 0x0F:
            raise BenchError(f"address 0x{address:02X} is not one of 0x0C..0x0F", device=name)
        if not (0.0 <= lo_V <= neutral_V <= hi_V <= full_V and neutral_V < full_V):
            raise BenchError(
                f"0 <= lo_V = {lo_V} <= neutral_V = {neutral_V} <= hi_V = {hi_V} <= {full_V} V does not hold",
                device=name,
            )
        self.name = name
        self.lsb_V = full_V / CODES
        top_V = min(hi_V, full_V - self.lsb_V)  # the highest code is one step below full scale
        self.limits = (OutputLimit(lo_V, top_V, slew_V_per_s, neutral_V),) * CHANNELS
        self.guard = OutputGuard(name, self.limits, clock)
        self.gate: OutputGate | None = None
        self._bus = bus
        self._clock = clock
        self._address = address
        self._codes_per_V = CODES / full_V
        self._update = I2cWrite(bytes((UPDATE | 0x7, 0, 0)))
        self._read_abc = (I2cWrite(bytes((ADDRESS_BITS[0],))), I2cRead(2 * CHANNELS))
        self._read_all = (I2cWrite(bytes((ADDRESS_BITS[0],))), I2cRead(2 * (CHANNELS + 1)))
        self._read_back = read_back
        self._probed = False
        self._position_known = False

    def probe(self) -> str:
        """Patterns through the input register of the unused DAC D: nothing moves, all 16 bits must hold.

        Also switches the internal reference on, all outputs to normal operation, and lets only the update
        command move them. Raises ``WrongDevice`` or ``I2cNack``.
        """
        for command in (
            (REFERENCE, 0, 0),  # 0: internal reference on
            (LDAC_MASK, 0, 0x0F),  # 1: the LDAC pin is ignored
            (POWER, 0, 0),  # 00 per channel: normal operation
        ):
            self._bus.transfer(self._address, [I2cWrite(bytes(command))])
        for pattern in PATTERNS:
            self._bus.transfer(self._address, [I2cWrite(bytes((WRITE_INPUT | SPARE, pattern >> 8, pattern & 0xFF)))])
            answer = self._bus.transfer(self._address, [I2cWrite(bytes((SPARE,))), I2cRead(2)])
            found = int.from_bytes(answer, "big")
            if found != pattern:
                raise WrongDevice(
                    f"wrote 0x{pattern:04X} to DAC D, read back 0x{found:04X}: not an AD5696R", device=self.name
                )
        self._probed = True
        return f"AD5696R at 0x{self._address:02X}, {self.limits[0].lo_V:.0f} .. {self.limits[0].hi_V:.0f} V"

    def arm(self) -> None:
        """Self-test, ramp to neutral, verify it by readback; then ``write`` is allowed.

        Takes about 20 ms of bench time. Raises ``SafetyTrip`` when the readback differs.
        """
        if not self._probed:
            self.probe()
        self._position_known = False
        while not self.safe_step():
            wait_s(self._clock, RAMP_TICK_S)
        self.guard.armed = True

    @property
    def commands_sent(self) -> int:
        return self.guard.writes

    @property
    def told_V(self) -> Sequence[float]:
        return self.guard.last_V

    def write(self, values_V: Float64Array) -> int:
        """``ProtocolError`` with ``read_back``: the DAC holds something else than it was told just now."""
        mask = self.guard.admit(values_V)
        self._send(self._read_abc if self._read_back else ())
        return mask

    def safe_step(self) -> bool:
        if not self._position_known:
            self.guard.start_from([float(v) for v in self.readback_V()])
            self._position_known = True
        done = self.guard.ramp()
        self._send()
        if done:
            found = self.read_codes()
            wanted = [self._code(limit.safe_V) for limit in self.limits]
            self.guard.require(found == wanted, f"neutral codes {wanted} read back as {found}")
        return done

    def lose_position(self) -> None:
        """Somebody else has moved the outputs: the next ramp begins where they are found."""
        self._position_known = False

    def verify(self) -> str:
        """Read all four input registers back, 0.26 ms at 400 kHz: empty, or what is not as it was told.

        DAC D holds a pattern since the probe; a part that has restarted has lost it.
        """
        answer = self._bus.transfer(self._address, self._read_all)
        *codes, spare = (int.from_bytes(answer[2 * i : 2 * i + 2], "big") for i in range(CHANNELS + 1))
        if spare != PATTERNS[-1]:
            return f"the DAC has restarted (register D holds 0x{spare:04X} instead of 0x{PATTERNS[-1]:04X})"
        for i, (code, told_V) in enumerate(zip(codes, self.guard.last_V, strict=True)):
            if code != self._code(told_V):
                return f"output {i + 1} holds {code * self.lsb_V:.3f} V and was told {told_V:.3f} V"
        return ""

    def readback_V(self) -> Float64Array:
        """Contents of the input registers, which equal the outputs after each update command."""
        return np.array(self.read_codes(), dtype=np.float64) * self.lsb_V

    def close(self) -> None:
        """Ramp to neutral unless there; the bus belongs to the bench and stays open."""
        if not self._position_known:
            return  # nothing was ever moved
        try:
            while not self.guard.at_safe_state() and not self.safe_step():
                wait_s(self._clock, RAMP_TICK_S)
        except HalError as error:
            raise type(error)(
                f"{error}; the outputs were NOT brought to neutral", kind=error.kind, device=self.name
            ) from error

    def channels(self) -> Sequence[ChannelInfo]:
        limit = self.limits[0]
        return [ChannelInfo(f"{self.name}.{i + 1}", "V", limit.lo_V, limit.hi_V, self.lsb_V) for i in range(CHANNELS)]

    def _code(self, value_V: float) -> int:
        return int(value_V * self._codes_per_V + 0.5)

    def _send(self, read_back: tuple[I2cOp, ...] = ()) -> None:
        k = self._codes_per_V
        a, b, c = self.guard.next_V
        a, b, c = int(a * k + 0.5), int(b * k + 0.5), int(c * k + 0.5)
        segments = (
            I2cWrite(bytes((0x11, a >> 8, a & 0xFF))),
            I2cWrite(bytes((0x12, b >> 8, b & 0xFF))),
            I2cWrite(bytes((0x14, c >> 8, c & 0xFF))),
            self._update,
            *read_back,
        )
        self.guard.not_before(self._clock.now_ns() + TRANSFER_NS)
        if self.gate is None:
            answer = self._bus.transfer(self._address, segments)
        else:
            self.gate.enter((a, b, c))
            try:
                answer = self._bus.transfer(self._address, segments)
            finally:
                self.gate.leave()
        self.guard.sent(READ_BACK_NS if read_back else 0)
        if read_back:
            self._compare(answer, (a, b, c))

    def _compare(self, answer: bytes, told: tuple[int, int, int]) -> None:
        held = [int.from_bytes(answer[2 * i : 2 * i + 2], "big") for i in range(CHANNELS)]
        for i, (code, wanted) in enumerate(zip(held, told, strict=True)):
            if code != wanted:
                self._position_known = False  # the ramp begins where the outputs are
                raise ProtocolError(
                    f"output {i + 1} holds {code * self.lsb_V:.3f} V and was told {wanted * self.lsb_V:.3f} V: check "
                    "the wires of the bus",
                    device=self.name,
                )

    def read_codes(self) -> list[int]:
        """Input registers A, B, C as codes."""
        answer = self._bus.transfer(self._address, self._read_abc)
        return [int.from_bytes(answer[2 * i : 2 * i + 2], "big") for i in range(CHANNELS)]
