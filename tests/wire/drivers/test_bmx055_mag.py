"""The BMX055's magnetometer, counts to tesla, against BST-BMX055-DS000 rev 1.1 and the maker's integer arithmetic."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.imu.bmx055_mag import MagTrim, counts


def test_magnetometer_counts():
    # 0x42: 13, 13, 15 and 14 bit, left-aligned, new data in bit 0 of 0x48
    assert counts(bytes.fromhex("f8ff 0800 feff 0500")) == (True, -1, 1, -1, 1)


def test_magnetometer_compensation_against_bosch_integer_arithmetic():
    """The integer form of the BMM050 API, written out here for one die; 1/16 uT per count."""
    trim = MagTrim(x1=1, y1=-2, x2=26, y2=25, z1=24747, z2=763, z3=-100, z4=7, xy1=29, xy2=-3, xyz1=6753)
    for x, y, z, rhall in [(120, -310, 900, 6800), (-1500, 44, -2000, 6600), (0, 0, 0, 6753)]:
        t = (trim.xyz1 << 14) // rhall - 0x4000
        gain = ((trim.xy2 * ((t * t) >> 7) + t * (trim.xy1 << 7)) >> 9) + 0x100000
        whole_x = ((x * ((gain * (trim.x2 + 0xA0)) >> 12)) >> 13) + (trim.x1 << 3)
        whole_y = ((y * ((gain * (trim.y2 + 0xA0)) >> 12)) >> 13) + (trim.y1 << 3)
        below = trim.z2 + ((trim.z1 * (rhall << 1) + (1 << 15)) >> 16)
        whole_z = (((z - trim.z4) << 15) - ((trim.z3 * (rhall - trim.xyz1)) >> 2)) / below
        assert trim.field_T(x, y, z, rhall) == pytest.approx(
            [whole_x / 16e6, whole_y / 16e6, whole_z / 16e6], abs=2 / 16e6
        )


def test_magnetometer_overflow_and_missing_trim():
    trim = MagTrim(0, 0, 0, 0, 24747, 763, 0, 0, 0, 0, 6753)
    assert np.isnan(trim.field_T(-4096, 0, 0, 6753)).tolist() == [True, False, False]
    assert np.isnan(trim.field_T(0, 0, -16384, 6753)).tolist() == [False, False, True]
    assert np.isnan(trim.field_T(0, 0, 0, 0)).all()
    blank = MagTrim.decode(bytes(21))
    assert blank.blank
    assert blank.field_T(16, 0, 0, 0)[0] == pytest.approx(5e-6)


def test_trim_block_layout():
    block = bytes.fromhex("01 fe 000000 0700 1a 19 0000 fb02 ab60 611a 9cff fd 1d")
    assert MagTrim.decode(block) == MagTrim(1, -2, 26, 25, 24747, 763, -100, 7, 29, -3, 6753)
