"""Checks that every I2C adapter makes on its arguments before it touches the wire."""

from __future__ import annotations

from hal.errors import BenchError


def check_address(address: int, device: str) -> None:
    """Raise ``BenchError`` when ``address`` is not a 7-bit address."""
    if not 0 <= address <= 0x7F:
        raise BenchError(
            f"I2C address 0x{address:X} is not 7 bit (0x00..0x7F); leave out the read/write bit", device=device
        )
