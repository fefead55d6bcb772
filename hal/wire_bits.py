"""Count the bits that a transaction occupies on its wire, for the load of a bus and for the time budget of a task.

Sources: UM10204 (NXP, rev. 7) section 3.1 for I2C; ISO 11898-1 for CAN frames and Davis et al. 2007, eq. 2, for the
bound of their stuff bits. Clock stretching, rise times and an adapter's gaps between bytes are not counted.
"""

from __future__ import annotations

from collections.abc import Sequence

from hal.types import I2cOp, I2cWrite


def i2c_bits(ops: Sequence[I2cOp]) -> int:
    """Bits of one transfer: a START or repeated START, address byte and data bytes of each segment, one STOP."""
    return 1 + sum(1 + 9 * (1 + (len(op.data) if isinstance(op, I2cWrite) else op.n)) for op in ops)


def serial_bits(n_bytes: int) -> int:
    """Bits of ``n_bytes`` in the format 8N1."""
    return 10 * n_bytes


def can_bits(n_data: int) -> int:
    """Return the largest number of bits of a classic base frame with ``n_data`` bytes, stuff bits included."""
    return 47 + 8 * n_data + (34 + 8 * n_data - 1) // 4
