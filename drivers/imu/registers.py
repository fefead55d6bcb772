"""Declares the registers of a chip (address, bits, reset value, access, source), and accesses them over I2C.

Chips differ in their maps, not in the access: one byte of register address, then data, with the address counting up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from hal.contracts import Clock, I2cBus
from hal.errors import HalTimeout, I2cNack, ProtocolError, WrongDevice
from hal.types import I2cRead, I2cWrite

Access = Literal["r", "w", "rw"]


@dataclass(frozen=True, slots=True)
class Register:
    """Describes one byte of a chip. ``reset`` is its value after reset, ``None`` where the data sheet leaves it
    open."""

    name: str
    address: int
    reset: int | None
    access: Access
    source: str

    def bits(self, high: int, low: int | None = None) -> Field:
        """Return the field of bits ``high`` down to ``low`` (one bit without ``low``), as data sheets write them."""
        low = high if low is None else low
        return Field(self, low, high - low + 1)


@dataclass(frozen=True, slots=True)
class Field:
    """Describes ``width`` neighbouring bits of a register, from bit ``low`` on."""

    register: Register
    low: int
    width: int

    @property
    def mask(self) -> int:
        return ((1 << self.width) - 1) << self.low

    def place(self, value: int) -> int:
        """Return ``value`` shifted to the field's place. Raises ``ValueError`` if it does not fit."""
        if not 0 <= value < 1 << self.width:
            raise ValueError(f"{value} does not fit into {self.width} bit of {self.register.name}")
        return value << self.low

    def take(self, byte: int) -> int:
        """Return the field's value in a byte that was read from its register."""
        return (byte & self.mask) >> self.low

    def replace(self, byte: int, value: int) -> int:
        """Return ``byte`` with this field set to ``value`` and its other bits kept."""
        return byte & ~self.mask | self.place(value)


def join(*parts: tuple[Field, int]) -> int:
    """Return one register value from several fields. Fields that are not named are zero."""
    value = 0
    for field, part in parts:
        value |= field.place(part)
    return value


class RegisterFile:
    """Accesses the registers of one chip at one address. ``name`` is the bench entry, for errors."""

    def __init__(self, bus: I2cBus, clock: Clock, address: int, name: str) -> None:
        self.address = address
        self.name = name
        self._bus = bus
        self._clock = clock

    def read(self, register: Register) -> int:
        return self.read_block(register, 1)[0]

    def read_block(self, first: Register, n: int) -> bytes:
        """Read ``n`` bytes from ``first`` on, in one transfer."""
        return self._bus.transfer(self.address, [I2cWrite(bytes((first.address,))), I2cRead(n)])

    def burst(self, first: Register, n: int) -> Callable[[], bytes]:
        """Return a prepared ``read_block`` for the loop."""
        transfer, address = self._bus.transfer, self.address
        ops = (I2cWrite(bytes((first.address,))), I2cRead(n))
        return lambda: transfer(address, ops)

    def write(self, register: Register, *values: int) -> None:
        """Write ``register`` and, with more values, those that follow it."""
        if register.access == "r":
            raise ProtocolError(f"register {register.name} is read-only ({register.source})", device=self.name)
        self._bus.transfer(self.address, [I2cWrite(bytes((register.address, *values)))])

    def write_checked(self, register: Register, *values: int) -> None:
        """Write as ``write`` does, and read back. Raises ``ProtocolError`` if something else comes back."""
        self.write(register, *values)
        read_back = self.read_block(register, len(values))
        if read_back != bytes(values):
            raise ProtocolError(
                f"{register.name} (0x{register.address:02X}) was written {bytes(values).hex()} and reads back "
                f"{read_back.hex()}; check supply, wiring and that nobody else drives this address",
                device=self.name,
            )

    def update(self, field: Field, value: int) -> int:
        """Change one field, keep the others; returns the whole byte written."""
        byte = field.replace(self.read(field.register), value)
        self.write(field.register, byte)
        return byte

    def update_checked(self, field: Field, value: int) -> None:
        """Update the field, and read it back; reserved bits are not compared. Raises ``ProtocolError``."""
        self.update(field, value)
        read_back = field.take(self.read(field.register))
        if read_back != value:
            raise ProtocolError(
                f"a field of {field.register.name} (0x{field.register.address:02X}) was set to {value} and reads "
                f"back {read_back}; check supply, wiring and that nobody else drives this address",
                device=self.name,
            )

    def identify(self, register: Register, part: str) -> None:
        """Compare an identity register with its fixed value. Raises ``WrongDevice``."""
        read_back = self.read(register)
        if read_back != register.reset:
            raise WrongDevice(
                f"{register.name} at address 0x{self.address:02X} reads 0x{read_back:02X}, {part} says "
                f"0x{register.reset:02X} ({register.source}); another part is strapped to this address",
                device=self.name,
            )

    def await_field(self, field: Field, value: int, limit_s: float, what: str, step_s: float = 0.001) -> None:
        """Poll ``field`` every ``step_s`` until it is ``value``. Raises ``HalTimeout`` after ``limit_s``.

        A chip that does not acknowledge, as during its reset, is polled on.
        """
        limit_ns = self._clock.now_ns() + round(limit_s * 1e9)
        while not self._is(field, value):
            if self._clock.now_ns() >= limit_ns:
                raise HalTimeout(
                    f"{what} not done after {limit_s} s ({field.register.name} says so); is the chip powered?",
                    device=self.name,
                )
            self._clock.sleep_until_ns(self._clock.now_ns() + round(step_s * 1e9))

    def _is(self, field: Field, value: int) -> bool:
        try:
            return field.take(self.read(field.register)) == value
        except I2cNack:
            return False


def signed(value: int, bits: int) -> int:
    """Return ``value`` read as two's complement of ``bits`` bits."""
    return value - (1 << bits) if value & 1 << (bits - 1) else value
