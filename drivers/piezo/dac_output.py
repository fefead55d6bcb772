"""Implements analog outputs of any I2C DAC with an amplifier.

A part is a subclass that defines the bytes on the bus. The DAC has no watchdog, so the firmware must take it to the
safe state; a guardian drives the same part through an object of its own (``firmware_py.guardian``).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import ClassVar, Protocol

import numpy as np

from drivers.options import OutputOptions
from drivers.output_guard import GuardedOutput, OutputGuard
from drivers.registry import Driver, Load, Site, Traffic
from hal.arrays import Array
from hal.contracts import Clock, I2cBus
from hal.errors import BenchError, HalError, ProtocolError
from hal.types import ChannelInfo, I2cOp, OutputLimit

CHANNELS = 3


class OutputGate(Protocol):
    """Grants every transfer that moves outputs. ``firmware_py.guardian.gate.LeaseGate`` implements it."""

    def enter(self, codes: tuple[int, int, int]) -> None:
        """Called before a transfer with its codes. If it raises, nothing is sent."""
        ...

    def leave(self) -> None:
        """Called after the transfer, also if that has raised."""
        ...


class DacOutput(GuardedOutput):
    """Implements ``AnalogOutput`` for three stacks, in V at the stack: ``arm``, then ``write``, at last ``safe_step``.

    A subclass sets the constants of its part and defines ``identify``, ``segments``, ``codes_of`` and ``verify``.
    """

    PART: ClassVar[str]
    ADDRESSES: ClassVar[tuple[int, ...]]
    """Addresses that the pins of the part can select; the first one is taken where a bench names none."""
    MAX_BUS_HZ: ClassVar[int]
    SPAN_V: ClassVar[float]
    """Full scale of the DAC, V; the highest code is one step below."""
    CODES: ClassVar[int]
    TRANSFER_NS: ClassVar[int]
    """Shortest time of a command's transfer on the fastest bus, less a bit for each segment."""
    READ_BACK_NS: ClassVar[int]
    """Shortest time for which a command that is read back has been in force at the end of its transfer."""
    READ_CODES: ClassVar[tuple[I2cOp, ...]]
    """Segments that read the three codes."""
    VERIFY: ClassVar[tuple[I2cOp, ...]] = ()
    """Segments that ``verify`` sends; the answer is words of 16 bits, high byte first, the three codes first."""
    CODE_AT: ClassVar[tuple[tuple[int, int], ...]] = ()
    """Segment, and byte in it, where the 16 bits of each code stand in ``segments``, for a compiled loop. Empty: the
    part has no such loop."""
    FIXED_WORDS: ClassVar[tuple[int, ...]] = ()
    """Words of the answer to ``VERIFY`` that follow the codes and never change."""
    WIRE_BITS: ClassVar[Mapping[str, int]]
    """Bits of what the loop repeats: "command", "command with read-back" and "verify". Retries are left out."""

    def __init__(
        self,
        bus: I2cBus,
        clock: Clock,
        address: int | None = None,
        *,
        gain: float = 20.0,
        lo_V: float = 0.0,
        hi_V: float = 100.0,
        neutral_V: float = 50.0,
        slew_V_per_s: float = 20_000.0,
        read_back: bool = False,
        name: str = "piezo",
    ) -> None:
        full_V = self.SPAN_V * gain
        address = self.ADDRESSES[0] if address is None else address
        if address not in self.ADDRESSES:
            first, last = self.ADDRESSES[0], self.ADDRESSES[-1]
            raise BenchError(f"address 0x{address:02X} is not one of 0x{first:02X}..0x{last:02X}", device=name)
        if not (0.0 <= lo_V <= neutral_V <= hi_V <= full_V and neutral_V < full_V):
            raise BenchError(
                f"lo_V = {lo_V}, neutral_V = {neutral_V}, hi_V = {hi_V}: they must rise"
                f" and lie within 0 .. {full_V:g} V",
                device=name,
            )
        self.name = name
        self.lsb_V = full_V / self.CODES
        top_V = min(hi_V, full_V - self.lsb_V)  # the highest code is one step below full scale
        self.limits = (OutputLimit(lo_V, top_V, slew_V_per_s, neutral_V),) * CHANNELS
        self.guard = OutputGuard(name, self.limits, clock)
        self.gate: OutputGate | None = None
        self.pending: bytes | HalError | None = None
        """Answer, or failure, of a transfer that a compiled loop has made and leaves to ``write`` or ``verify``."""
        self.bus = bus
        self._clock = clock
        self.address = address
        self.codes_per_V = self.CODES / full_V
        self.read_back = read_back
        self._probed = False
        self._position_known = False

    def probe(self) -> str:
        """Identify the part and prepare it for commands; nothing moves. Raises ``WrongDevice`` or ``I2cNack``."""
        self.identify()
        self._probed = True
        return f"{self.PART} at 0x{self.address:02X}, {self.limits[0].lo_V:.0f} .. {self.limits[0].hi_V:.0f} V"

    def identify(self) -> None:
        """Exchange what shows that this is the part. Raises ``WrongDevice``."""
        raise NotImplementedError

    def segments(self, a: int, b: int, c: int) -> tuple[I2cOp, ...]:
        """Return the transfer that moves outputs 1, 2 and 3 to the codes ``a``, ``b`` and ``c``."""
        raise NotImplementedError

    def codes_of(self, answer: bytes) -> list[int]:
        """Return the three codes in the answer to ``READ_CODES``."""
        raise NotImplementedError

    def verify(self) -> str:
        """Read the part back. Return an empty text, or what differs from the last command."""
        raise NotImplementedError

    def transfer(self, ops: Sequence[I2cOp]) -> bytes:
        """Make one transfer to the part."""
        return self.bus.transfer(self.address, ops)

    @property
    def is_ready(self) -> bool:
        """True if a compiled loop may command the part: it is armed, and no answer is pending."""
        return self._position_known and self.guard.armed and self.pending is None

    def answer_to_verify(self) -> bytes:
        """Return the answer to ``VERIFY``, the pending one if there is one."""
        return self.transfer(self.VERIFY) if self.pending is None else self._take_pending()

    def _take_pending(self) -> bytes:
        pending, self.pending = self.pending, None
        if isinstance(pending, HalError):
            raise pending
        assert pending is not None
        return pending

    def arming(self) -> Iterator[None]:
        """Self-test, ramp to neutral, verify it by readback; then ``write`` is allowed.

        Takes about 20 ms of bench time. Raises ``SafetyTrip`` when the readback differs.
        """
        if not self._probed:
            self.probe()
        self._position_known = False
        while not self.safe_step():
            yield
        self.guard.armed = True

    def write(self, values_V: Array) -> int:
        """Write ``values_V`` (3,) and return the mask, both as ``AnalogOutput.write`` says. With ``read_back``, raises
        ``ProtocolError`` if the DAC holds another command. Raises ``LeaseLost`` if the guardian has the outputs."""
        if self.pending is not None:
            a, b, c = (self._code(value_V) for value_V in self.guard.next_V)
            self._compare(self._take_pending(), (a, b, c))
        mask = self.guard.admit(values_V)
        self._send(self.READ_CODES if self.read_back else ())
        return mask

    def safe_step(self) -> bool:
        """Make one step of the ramp; the first one reads the outputs back. Return True once neutral is read back."""
        if not self._position_known:
            self.guard.start_from([float(v) for v in self.readback_V()])
            self._position_known = True
        done = self.guard.ramp()
        self._send()
        if done:
            codes = self.read_codes()
            wanted = [self._code(limit.safe_V) for limit in self.limits]
            self.guard.require(codes == wanted, f"neutral codes {wanted} read back as {codes}")
        return done

    def lose_position(self) -> None:
        """Note that the guardian may have moved the outputs: the next ramp reads them back first."""
        self._position_known = False

    def differences(self, codes: Sequence[int]) -> str:
        """Return what differs between ``codes`` and the last command; empty if nothing does."""
        for i, (code, commanded_V) in enumerate(zip(codes, self.guard.last_V, strict=True)):
            if code != self._code(commanded_V):
                return f"output {i + 1} holds {code * self.lsb_V:.3f} V and was told {commanded_V:.3f} V"
        return ""

    def readback_V(self) -> Array:
        """Return the input registers as volts (3,). They equal the outputs after each update command."""
        return np.array(self.read_codes(), dtype=np.float64) * self.lsb_V

    def close(self) -> None:
        """Ramp to neutral unless there; the bus belongs to the bench and stays open."""
        if not self._position_known:
            return  # nothing was ever moved
        self.ramp_to_neutral()

    def channels(self) -> Sequence[ChannelInfo]:
        limit = self.limits[0]
        return [ChannelInfo(f"{self.name}.{i + 1}", "V", limit.lo_V, limit.hi_V, self.lsb_V) for i in range(CHANNELS)]

    def _code(self, value_V: float) -> int:
        return int(value_V * self.codes_per_V + 0.5)

    def _send(self, read_back: tuple[I2cOp, ...] = ()) -> None:
        k = self.codes_per_V
        a, b, c = self.guard.next_V
        a, b, c = int(a * k + 0.5), int(b * k + 0.5), int(c * k + 0.5)
        segments = (*self.segments(a, b, c), *read_back)
        self.guard.not_before(self._clock.now_ns() + self.TRANSFER_NS)
        if self.gate is None:
            answer = self.bus.transfer(self.address, segments)
        else:
            self.gate.enter((a, b, c))
            try:
                answer = self.bus.transfer(self.address, segments)
            finally:
                self.gate.leave()
        self.guard.sent(self.READ_BACK_NS if read_back else 0)
        if read_back:
            self._compare(answer, (a, b, c))

    def _compare(self, answer: bytes, commanded: tuple[int, int, int]) -> None:
        for i, (code, wanted) in enumerate(zip(self.codes_of(answer), commanded, strict=True)):
            if code != wanted:
                self._position_known = False  # the ramp begins where the outputs are
                raise ProtocolError(
                    f"output {i + 1} holds {code * self.lsb_V:.3f} V and was told {wanted * self.lsb_V:.3f} V: check "
                    "the wires of the bus",
                    device=self.name,
                )

    def read_codes(self) -> list[int]:
        """Return the codes of the three outputs as the part holds them."""
        return self.codes_of(self.transfer(self.READ_CODES))


def output_driver(part: type[DacOutput], options: type[OutputOptions]) -> Driver:
    """Return the record of a driver whose device is ``part`` and whose keys are the keywords of its constructor."""

    def open_part(site: Site) -> DacOutput:
        bus = site.bench.i2c(site.spec.bus or "")
        return part(bus, site.bench.clock, site.spec.address, name=site.name, **site.options.model_dump())

    def traffic(load: Load) -> Iterator[Traffic]:
        command = "command with read-back" if getattr(load.options, "read_back", False) else "command"
        yield Traffic(command, part.WIRE_BITS[command], load.tick_hz, "actuate")
        if load.polling.verify is not None:
            yield Traffic("verify", part.WIRE_BITS["verify"], load.polling.verify.per_s(load.tick_hz), "verify")

    return Driver(
        options, open_part, "output", traffic=traffic, addresses=part.ADDRESSES, max_bus_hz=part.MAX_BUS_HZ,
        leased=part, verifies=True, has_kernels=bool(part.CODE_AT and part.VERIFY),
    )  # fmt: skip
