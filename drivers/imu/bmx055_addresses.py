"""Lists the sets of three I2C addresses that the straps of one BMX055 can select.

Source: BST-BMX055-DS000 rev 1.1, "I2C interface".
"""

from __future__ import annotations

from hal.errors import BenchError

ACCEL_ADDRESSES = (0x18, 0x19)  # SDO1 low, high
GYRO_ADDRESSES = (0x68, 0x69)  # SDO2 low, high
MAG_ADDRESSES = (0x10, 0x11, 0x12, 0x13)  # bit 0 is SDO2, bit 1 CSB3


def check_addresses(accel: int, gyro: int, mag: int, name: str) -> None:
    """``BenchError`` for addresses that no strapping gives. SDO2 serves gyro and magnetometer together."""
    for what, address, good in (
        ("accelerometer", accel, ACCEL_ADDRESSES),
        ("gyro", gyro, GYRO_ADDRESSES),
        ("magnetometer", mag, MAG_ADDRESSES),
    ):
        if address not in good:
            listed = ", ".join(f"0x{a:02X}" for a in good)
            raise BenchError(f"{what} address 0x{address:02X} is not one of {listed}", device=name)
    if gyro & 1 != mag & 1:
        raise BenchError(
            f"gyro 0x{gyro:02X} and magnetometer 0x{mag:02X} cannot go together: SDO2 sets the lowest bit of both",
            device=name,
        )
