"""I2C chips with 16-bit registers behind a pointer byte: what an emulator of one has to say is what its registers do.

Source: UM10204 (I2C-bus specification) sec. 3.1.10; the high byte goes first, a longer read repeats the register, as in
data sheets of such parts (ADS111x, TMP117).

Model limits
- Bytes are read and written at the end of their segment, all at one instant; there is no auto-increment.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from types import MappingProxyType

from sim_devices.devices.acting import ActingFace
from sim_devices.registry import Surroundings

RESET = 0x06  # general call


class WordFace(ActingFace):
    """Implements the wire face of one chip. ``power_up`` holds its registers, ``read_only`` those that the host cannot
    write.

    ``nack_address`` and ``nack_data`` are hooks for faults.
    """

    power_up: Mapping[int, int] = MappingProxyType({})
    read_only: Collection[int] = ()

    def __init__(self, around: Surroundings) -> None:
        self.around = around
        self.nack_address = self.nack_data = False
        self._reset(around.start_ns)

    def _reset(self, t_ns: int) -> None:
        self.words: dict[int, int] = dict(self.power_up)
        self.due_ns = None
        self._pointer = 0
        self.was_reset(t_ns)

    # ------------------------------------------------------------------ for the chip to override

    def was_reset(self, t_ns: int) -> None:
        """Power-up, or a general call."""

    def was_read(self, register: int) -> None:
        """A side effect of reading ``register``."""

    def was_written(self, register: int, t_ns: int) -> None:
        """An effect of writing ``register``."""

    # ------------------------------------------------------------------ wire face

    def acknowledges(self) -> bool:
        return not self.nack_address

    def write(self, data: bytes, t_ns: int) -> int:
        if self.nack_data:
            return 0
        self.advance_to(t_ns)
        if data:
            self._pointer = data[0]
        if len(data) >= 3 and self._pointer in self.words and self._pointer not in self.read_only and not self.frozen:
            self.words[self._pointer] = data[1] << 8 | data[2]
            self.was_written(self._pointer, t_ns)
        return len(data)

    def read(self, n: int, t_ns: int) -> bytes:
        self.advance_to(t_ns)
        word = self.words.get(self._pointer, 0)
        self.was_read(self._pointer)
        return (word.to_bytes(2, "big") * (n // 2 + 1))[:n]

    def general_call(self, data: bytes, t_ns: int) -> bool:
        if data[:1] == bytes((RESET,)):
            self._reset(t_ns)
        return not self.nack_address
