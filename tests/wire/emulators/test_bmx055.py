"""The emulated BMX055, three dies, against its data sheet (BST-BMX055-DS000 rev. 1.3) and the BMM150 compensation."""

from __future__ import annotations

import numpy as np
import pytest

from sim_devices.devices.bmx055 import Bmx055Accelerometer, Bmx055Gyroscope
from sim_devices.devices.bmx055_magnetometer import Bmx055Magnetometer
from sim_devices.plant.imu import BMX055_SPEC
from tests.wire.emulators.imu_stand import Stand, get, put, words

MS = 1_000_000


def accelerometer() -> tuple[Bmx055Accelerometer, Stand]:
    stand = Stand()
    return Bmx055Accelerometer(stand.imu(BMX055_SPEC)), stand


def gyroscope() -> tuple[Bmx055Gyroscope, Stand]:
    stand = Stand()
    return Bmx055Gyroscope(stand.imu(BMX055_SPEC)), stand


def magnetometer() -> tuple[Bmx055Magnetometer, Stand]:
    stand = Stand()
    return Bmx055Magnetometer(stand.imu(BMX055_SPEC)), stand


# ---------------------------------------------------------------------- accelerometer


def test_accelerometer_reset_values() -> None:
    """Section 5, register map: chip id FAh, range 03h, bandwidth 0Fh."""
    device, _ = accelerometer()
    expected = {0x00: 0xFA, 0x0F: 0x03, 0x10: 0x0F, 0x11: 0, 0x13: 0, 0x20: 0x05, 0x21: 0, 0x22: 0x09, 0x2D: 0x08}
    expected |= {0x33: 0xF4, 0x36: 0x10, 0x38: 0, 0x3E: 0}
    assert {register: get(device, register, 0)[0] for register in expected} == expected


@pytest.mark.parametrize(("code", "lsb_per_g"), [(0x3, 1024), (0x5, 512), (0x8, 256), (0xC, 128)])
def test_accelerometer_twelve_bits_left_aligned(code: int, lsb_per_g: int) -> None:
    device, stand = accelerometer()
    put(device, 0x0F, code, t_ns=0)
    stand.g = np.array([0.5, -0.25, 1.0])
    data = get(device, 0x02, 20 * MS, 6)
    assert [v >> 4 for v in words(data, "little")] == [round(g * lsb_per_g) for g in (0.5, -0.25, 1.0)]
    assert [byte & 1 for byte in data[::2]] == [1, 1, 1]  # new_data
    assert [byte & 1 for byte in get(device, 0x02, 20 * MS, 6)[::2]] == [0, 0, 0]


@pytest.mark.parametrize(
    ("code", "period_us"), [(0x08, 64_000), (0x0B, 8_000), (0x0D, 2_000), (0x0F, 500), (0x1F, 500)]
)
def test_accelerometer_update_time(code: int, period_us: int) -> None:
    device, _ = accelerometer()
    put(device, 0x10, code, t_ns=0)
    device.advance_to(10 * period_us * 1000)
    assert device.samples == 10


def test_accelerometer_msb_is_locked_by_its_lsb() -> None:
    device, stand = accelerometer()
    stand.g = np.array([0.999 * 256 / 1024, 0.0, 1.0])
    low = get(device, 0x02, 10 * MS)[0]
    stand.g = np.array([1.5, 0.0, 1.0])
    high = get(device, 0x03, 30 * MS)[0]
    assert (high << 8 | low) >> 4 == round(0.999 * 256)
    assert get(device, 0x03, 30 * MS)[0] << 4 == 1536 & 0xFF0
    put(device, 0x13, 0x40, t_ns=30 * MS)  # shadow_dis
    get(device, 0x02, 40 * MS)
    stand.g = np.zeros(3)
    assert get(device, 0x03, 60 * MS) == b"\0"


def test_accelerometer_temperature() -> None:
    device, stand = accelerometer()
    stand.temperature_C = 28.0
    assert get(device, 0x08, MS) == b"\x0a"  # 23 degC at 0, 0.5 K per LSB


def test_accelerometer_soft_reset() -> None:
    device, _ = accelerometer()
    put(device, 0x0F, 0x0C, t_ns=0)
    put(device, 0x14, 0xB5, t_ns=0)  # not the command
    assert get(device, 0x0F, 0) == b"\x0c"
    put(device, 0x14, 0xB6, t_ns=0)
    assert get(device, 0x00, MS) == b"\0"
    assert get(device, 0x00, 1_800_000) == b"\xfa"
    assert get(device, 0x0F, 1_800_000) == b"\x03"


def test_accelerometer_suspend() -> None:
    device, _ = accelerometer()
    put(device, 0x11, 0x80, t_ns=0)
    device.advance_to(100 * MS)
    assert device.samples == 0
    put(device, 0x11, 0x00, t_ns=100 * MS)
    device.advance_to(110 * MS)
    assert device.samples == 16  # 1.8 ms, then each 0.5 ms


def test_accelerometer_offset_registers_and_nvm() -> None:
    """7.81 mg per LSB in every range; programming needs prog_mode, then survives the soft reset."""
    device, stand = accelerometer()
    stand.g = np.zeros(3)
    put(device, 0x38, 0x10, 0xF0, 0x00, t_ns=0)
    x, y, z = (v >> 4 for v in words(get(device, 0x02, 20 * MS, 6), "little"))
    assert (x, y, z) == (128, -128, 0)
    put(device, 0x33, 0x02, t_ns=20 * MS)  # without prog_mode: nothing
    assert get(device, 0x33, 21 * MS) == b"\xf4"
    put(device, 0x33, 0x01, t_ns=21 * MS)
    put(device, 0x33, 0x03, t_ns=22 * MS)
    assert get(device, 0x33, 23 * MS)[0] & 0x04 == 0
    assert get(device, 0x33, 40 * MS) == b"\xe5"  # ready, one cycle less
    put(device, 0x14, 0xB6, t_ns=40 * MS)
    assert get(device, 0x38, 50 * MS, 3) == b"\x10\xf0\x00"
    put(device, 0x36, 0x80, t_ns=50 * MS)  # offset_reset
    assert get(device, 0x38, 50 * MS, 3) == b"\0\0\0"


def test_accelerometer_fast_compensation() -> None:
    device, stand = accelerometer()
    stand.g = np.array([0.078, 0.0, 1.05])
    put(device, 0x37, 0x20, t_ns=0)  # z target +1 g
    put(device, 0x36, 0x60, t_ns=0)
    assert get(device, 0x36, MS)[0] & 0x10 == 0
    assert get(device, 0x36, 20 * MS)[0] & 0x10
    assert get(device, 0x38, 20 * MS, 3) == bytes((0, 0, -6 & 0xFF))


def test_accelerometer_self_test_difference() -> None:
    """Section 4.5.2: difference of both signs at least 800, 800, 400 mg."""
    device, stand = accelerometer()
    stand.g = np.zeros(3)
    t_ns = 0
    for axis, least in enumerate((0.8, 0.8, 0.4)):
        values: list[int] = []
        for sign in (0x04, 0x00):
            put(device, 0x32, 0x10 | sign | axis + 1, t_ns=t_ns)
            t_ns += 50 * MS
            values.append(words(get(device, 0x02, t_ns, 6), "little")[axis] >> 4)
        assert (values[0] - values[1]) / 1024 > least


def test_accelerometer_fifo() -> None:
    device, _ = accelerometer()
    put(device, 0x10, 0x0B, t_ns=0)  # 125 Hz
    put(device, 0x3E, 0x80, t_ns=0)  # stream
    device.advance_to(20 * 8 * MS)
    assert get(device, 0x0E, 160 * MS) == b"\x14"
    frames = words(get(device, 0x3F, 160 * MS, 12), "little")
    assert frames[2] == 1024 << 4
    assert frames[5] == 1024 << 4
    assert get(device, 0x0E, 160 * MS) == b"\x12"
    get(device, 0x3F, 160 * MS, 8)  # one frame and a part: the part is lost
    assert get(device, 0x0E, 160 * MS) == b"\x10"
    device.advance_to(400 * MS)
    assert get(device, 0x0E, 400 * MS) == b"\xa0"  # overrun, 32 frames
    put(device, 0x3E, 0x40, t_ns=400 * MS)  # FIFO mode: writing clears
    assert get(device, 0x0E, 400 * MS) == b"\0"


# ---------------------------------------------------------------------- gyroscope


def test_gyroscope_reset_values() -> None:
    device, _ = gyroscope()
    expected = {0x00: 0x0F, 0x0F: 0x00, 0x10: 0x80, 0x11: 0, 0x16: 0x0F, 0x33: 0xF4, 0x36: 0, 0x3C: 0x10}
    assert {register: get(device, register, 0)[0] for register in expected} == expected


@pytest.mark.parametrize(("code", "lsb"), [(0, 16.4), (1, 32.8), (2, 65.6), (3, 131.2), (4, 262.4)])
def test_gyroscope_scale(code: int, lsb: float) -> None:
    device, stand = gyroscope()
    put(device, 0x0F, code, t_ns=0)
    stand.dps = np.array([100.0, -50.0, 10.0])
    assert words(get(device, 0x02, 100 * MS, 6), "little") == [round(v * lsb) for v in (100.0, -50.0, 10.0)]


@pytest.mark.parametrize(
    ("code", "rate_hz"), [(0, 2000), (1, 2000), (2, 1000), (3, 400), (4, 200), (5, 100), (6, 200), (7, 100)]
)
def test_gyroscope_data_rate(code: int, rate_hz: int) -> None:
    device, _ = gyroscope()
    put(device, 0x10, code, t_ns=0)
    assert get(device, 0x10, 0)[0] == 0x80 | code
    device.advance_to(100 * MS)
    assert device.samples == rate_hz // 10


def test_gyroscope_new_data_interrupt_latched() -> None:
    device, _ = gyroscope()
    put(device, 0x10, 0x05, t_ns=0)
    assert get(device, 0x0A, 10 * MS) == b"\0"  # not enabled
    put(device, 0x15, 0x80, t_ns=0)
    assert get(device, 0x0A, 20 * MS) == b"\x80"
    assert get(device, 0x0A, 21 * MS) == b"\0"  # not latched: 300 us
    put(device, 0x21, 0x8F, t_ns=21 * MS)
    assert get(device, 0x0A, 35 * MS) == b"\x80"
    put(device, 0x21, 0x8F, t_ns=35 * MS)
    assert get(device, 0x0A, 36 * MS) == b"\0"


def test_gyroscope_soft_reset_takes_30_ms() -> None:
    device, _ = gyroscope()
    put(device, 0x14, 0xB6, t_ns=0)
    assert get(device, 0x00, 29 * MS) == b"\0"
    assert get(device, 0x00, 30 * MS) == b"\x0f"


@pytest.mark.parametrize("raw", [1, -1, 100, -723, 2047, -2048])
def test_gyroscope_offset_bits(raw: int) -> None:
    """x<11:4> in 37h, <3:2> in 36h 7:6, <1:0> in 3Ah 3:2; y: 38h, 36h 5:3, 3Ah 1; z: 39h, 36h 2:0, 3Ah 0."""
    device, stand = gyroscope()
    bits = raw & 0xFFF
    ofc1 = (bits >> 2 & 3) << 6 | (bits >> 1 & 7) << 3 | bits >> 1 & 7
    gp0 = (bits & 3) << 2 | (bits & 1) << 1 | bits & 1
    put(device, 0x36, ofc1, bits >> 4, bits >> 4, bits >> 4, gp0, t_ns=0)
    put(device, 0x0F, 3, t_ns=0)
    values = words(get(device, 0x02, 50 * MS, 6), "little")
    assert values == [pytest.approx(raw * 0.061 * 131.2, abs=0.6)] * 3
    assert stand.dps.sum() == 0


def test_gyroscope_fast_offset_compensation() -> None:
    device, stand = gyroscope()
    put(device, 0x0F, 0x04, t_ns=0)
    stand.dps = np.array([0.8, -0.6, 0.3])
    put(device, 0x32, 0x0F, t_ns=0)
    assert get(device, 0x32, 10 * MS)[0] & 0x08
    assert get(device, 0x32, 50 * MS)[0] & 0x08 == 0
    left = np.array(words(get(device, 0x02, 60 * MS, 6), "little")) / 262.4
    assert np.all(np.abs(left) <= 0.061 / 2 + 0.01)


def test_gyroscope_fifo_and_empty_words() -> None:
    device, _ = gyroscope()
    put(device, 0x10, 0x03, t_ns=0)
    put(device, 0x3E, 0x40, t_ns=0)
    assert get(device, 0x0E, 25 * MS) == b"\x0a"
    get(device, 0x3F, 25 * MS, 60)
    assert words(get(device, 0x3F, 25 * MS, 6), "little") == [-32768] * 3
    device.advance_to(400 * MS)
    assert get(device, 0x0E, 400 * MS) == bytes((0x80 | 100,))


def test_gyroscope_built_in_self_test() -> None:
    device, _ = gyroscope()
    put(device, 0x3C, 0x01, t_ns=0)
    assert get(device, 0x3C, 0)[0] & 0x02 == 0
    assert get(device, 0x3C, MS) == b"\x12"  # rate_ok, bist_rdy, no bist_fail


# ---------------------------------------------------------------------- magnetometer


def compensated(device: Bmx055Magnetometer, data: bytes) -> list[float]:
    """The vendor's floating-point compensation, with trim read as the data sheet's user would."""
    low8 = {name: get(device, at, 10**12)[0] for name, at in (("x1", 0x5D), ("y1", 0x5E), ("x2", 0x64), ("y2", 0x65))}
    x1, y1, x2, y2 = (v - 256 if v > 127 else v for v in low8.values())
    xy2, xy1 = get(device, 0x70, 10**12, 2)
    xy2 = xy2 - 256 if xy2 > 127 else xy2
    z4, z2, z3 = (words(get(device, at, 10**12, 2), "little")[0] for at in (0x62, 0x68, 0x6E))
    z1, xyz1 = (int.from_bytes(get(device, at, 10**12, 2), "little") for at in (0x6A, 0x6C))
    raw_x, raw_y, raw_z, _ = words(data, "little")
    mx, my, mz, rhall = raw_x >> 3, raw_y >> 3, raw_z >> 1, int.from_bytes(data[6:], "little") >> 2
    out: list[float] = []
    for m, d1, d2 in ((mx, x1, x2), (my, y1, y2)):
        r = xyz1 * 16384.0 / rhall - 16384.0
        gain = (xy2 * (r * r / 268435456.0) + r * xy1 / 16384.0 + 256.0) * (d2 + 160.0)
        out.append((m * gain / 8192.0 + d1 * 8.0) / 16.0)
    out.append(((mz - z4) * 131072.0 - z3 * (rhall - xyz1)) / ((z2 + z1 * rhall / 32768.0) * 4.0) / 16.0)
    return out


def test_magnetometer_is_deaf_in_suspend() -> None:
    device, _ = magnetometer()
    assert get(device, 0x40, 0) == b"\0"
    assert get(device, 0x4B, 0) == b"\0"
    put(device, 0x4C, 0x00, t_ns=0)
    put(device, 0x4B, 0x01, t_ns=0)
    assert get(device, 0x40, 2 * MS) == b"\0"  # 3 ms from suspend to sleep
    assert get(device, 0x40, 3 * MS) == b"\x32"
    assert get(device, 0x4C, 3 * MS, 3) == b"\x06\x3f\x07"


def test_magnetometer_forced_mode_conversion_time() -> None:
    """145 us x nXY + 500 us x nZ + 980 us; nXY = 1 + 2 REPXY, nZ = 1 + REPZ (section 10.2)."""
    device, stand = magnetometer()
    stand.temperature_C = 35.0
    put(device, 0x4B, 0x01, t_ns=0)
    put(device, 0x51, 4, 14, t_ns=5 * MS)
    put(device, 0x4C, 0x02, t_ns=5 * MS)
    ready_ns = 5 * MS + 9 * 145_000 + 15 * 500_000 + 980_000
    assert get(device, 0x48, ready_ns - 1)[0] & 1 == 0
    data = get(device, 0x42, ready_ns, 8)
    assert data[6] & 1
    assert get(device, 0x4C, ready_ns)[0] & 0x06 == 0x06  # back to sleep
    assert get(device, 0x48, ready_ns)[0] & 1 == 0
    assert compensated(device, data) == pytest.approx([20.0, 0.0, -44.0], abs=0.5)
    assert device.next_event_ns() is None


@pytest.mark.parametrize(("code", "rate_hz"), [(0, 10), (1, 2), (4, 15), (7, 30)])
def test_magnetometer_normal_mode_rate(code: int, rate_hz: int) -> None:
    device, _ = magnetometer()
    put(device, 0x4B, 0x01, t_ns=0)
    put(device, 0x4C, code << 3, t_ns=10 * MS)
    device.advance_to(10 * MS + 2_000 * MS)
    assert device.samples == 2 * rate_hz


def test_magnetometer_soft_reset_keeps_power() -> None:
    device, _ = magnetometer()
    put(device, 0x4B, 0x01, t_ns=0)
    put(device, 0x51, 23, t_ns=5 * MS)
    put(device, 0x4B, 0x83, t_ns=6 * MS)
    assert get(device, 0x51, 8 * MS) == b"\0"
    assert get(device, 0x40, 8 * MS) == b"\x32"


def test_magnetometer_overflow() -> None:
    device, stand = magnetometer()
    stand.field_uT = np.array([5000.0, 0.0, 0.0])
    put(device, 0x4B, 0x01, t_ns=0)
    put(device, 0x4C, 0x02, t_ns=5 * MS)
    assert words(get(device, 0x42, 50 * MS, 2), "little")[0] >> 3 == -4096
    assert get(device, 0x4A, 50 * MS)[0] & 0x40


def test_magnetometer_self_test_bits() -> None:
    """Section 10.4: bit 0 of 4Ch clears when done; bit 0 of the x, y and z LSBs say that the channel passed."""
    device, _ = magnetometer()
    put(device, 0x4B, 0x01, t_ns=0)
    put(device, 0x4C, 0x07, t_ns=5 * MS)
    assert get(device, 0x4C, 6 * MS)[0] & 1
    assert get(device, 0x4C, 7 * MS) == b"\x06"
    data = get(device, 0x42, 7 * MS, 8)
    assert [byte & 1 for byte in data[:6:2]] == [1, 1, 1]
    assert data[6] & 1 == 0  # no new data


def test_magnetometer_advanced_self_test() -> None:
    """Difference of z between both currents: about 200 uT."""
    device, _ = magnetometer()
    put(device, 0x4B, 0x01, t_ns=0)
    put(device, 0x52, 14, t_ns=5 * MS)
    z: list[float] = []
    for k, current in enumerate((0xC0, 0x80)):
        put(device, 0x4C, current | 0x02, t_ns=(10 + 50 * k) * MS)
        z.append(compensated(device, get(device, 0x42, (40 + 50 * k) * MS, 8))[2])
    assert z[0] - z[1] == pytest.approx(200.0, abs=1.0)
