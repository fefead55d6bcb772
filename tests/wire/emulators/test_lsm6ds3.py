"""The emulated LSM6DS3 against its data sheet (DocID026899 rev. 10) and AN4650."""

from __future__ import annotations

import numpy as np
import pytest

from hal.types import I2cRead, I2cWrite
from sim_devices.devices.lsm6ds3 import Lsm6ds3
from sim_devices.plant.imu import LSM6DS3_SPEC
from sim_devices.transports.i2c_line import I2cLine
from tests.wire.emulators.imu_stand import Stand, get, put, words

MS = 1_000_000


def make() -> tuple[Lsm6ds3, Stand]:
    stand = Stand()
    return Lsm6ds3(stand.imu(LSM6DS3_SPEC)), stand


def running(xl: int = 0x40, g: int = 0x40, ctrl3: int = 0x44) -> tuple[Lsm6ds3, Stand]:
    """104 Hz both, +-2 g, 245 dps, BDU and IF_INC."""
    device, stand = make()
    put(device, 0x12, ctrl3, t_ns=0)
    put(device, 0x10, xl, g, t_ns=0)
    return device, stand


def test_reset_values() -> None:
    """Data sheet section 8: WHO_AM_I 69h, CTRL3_C 04h, CTRL9_XL and CTRL10_C 38h, FIFO empty, others 0."""
    device, _ = make()
    expected = {0x0F: 0x69, 0x12: 0x04, 0x18: 0x38, 0x19: 0x38, 0x3B: 0x10}
    for register in (*range(0x01, 0x3E), *range(0x58, 0x60)):
        assert get(device, register, 0)[0] == expected.get(register, 0), hex(register)


def test_powered_down_at_start() -> None:
    device, _ = make()
    device.advance_to(1000 * MS)
    assert device.next_event_ns() is None
    assert get(device, 0x1E, 1000 * MS) == b"\0"


@pytest.mark.parametrize("register", [0x0F, 0x1E, 0x28, 0x3A, 0x3E])
def test_read_only_registers(register: int) -> None:
    device, _ = make()
    before = get(device, register, 0)
    put(device, register, 0xA5, t_ns=0)
    assert get(device, register, 0) == before


@pytest.mark.parametrize(
    ("code", "rate_hz"),
    [(1, 12.5), (2, 26), (3, 52), (4, 104), (5, 208), (6, 416), (7, 833), (8, 1660), (9, 3330), (10, 6660)],
)
def test_data_rates(code: int, rate_hz: float) -> None:
    device, _ = make()
    put(device, 0x10, code << 4, t_ns=0)
    device.advance_to(round(20e9 / rate_hz) + 10)
    assert device.samples[0] == 20


@pytest.mark.parametrize(("fs", "mg"), [(0, 0.061), (1, 0.488), (2, 0.122), (3, 0.244)])
def test_accelerometer_scale_little_endian(fs: int, mg: float) -> None:
    device, stand = running(xl=0x40 | fs << 2)
    stand.g = np.array([0.5, -0.25, 1.0])
    values = words(get(device, 0x28, 300 * MS, 6), "little")
    assert values == [round(v * 1000 / mg) for v in (0.5, -0.25, 1.0)]


@pytest.mark.parametrize(("bits", "mdps"), [(0x0, 8.75), (0x4, 17.5), (0x8, 35), (0xC, 70), (0x2, 4.375)])
def test_gyroscope_scale(bits: int, mdps: float) -> None:
    device, stand = running(g=0x40 | bits)
    stand.dps = np.array([100.0, -50.0, 10.0])
    values = words(get(device, 0x22, 600 * MS, 6), "little")
    assert values == [round(v * 1000 / mdps) for v in (100.0, -50.0, 10.0)]


def test_temperature_16_lsb_per_degree_from_25() -> None:
    device, stand = running()
    stand.temperature_C = 31.25
    assert words(get(device, 0x20, 300 * MS, 2), "little") == [100]


def test_status_falls_when_a_high_byte_is_read() -> None:
    device, _ = running()
    assert get(device, 0x1E, 5 * MS) == b"\0"
    assert get(device, 0x1E, 10 * MS)[0] & 3 == 3
    get(device, 0x28, 10 * MS, 1)  # a low byte changes nothing
    assert get(device, 0x1E, 10 * MS)[0] & 3 == 3
    get(device, 0x28, 10 * MS, 2)
    assert get(device, 0x1E, 10 * MS)[0] & 3 == 2
    get(device, 0x22, 10 * MS, 6)
    assert get(device, 0x1E, 10 * MS)[0] & 3 == 0
    assert get(device, 0x1E, 20 * MS)[0] & 3 == 3


def torn_pairs(ctrl3: int) -> int:
    """Bursts at 100 kHz while x walks through byte boundaries at 1.66 kHz: how often the halves do not match."""
    device, stand = make()
    put(device, 0x12, ctrl3, t_ns=0)
    put(device, 0x10, 0x80, t_ns=0)
    stand.ramp_g = np.array([10.0, 0.0, 0.0])
    stand.g = np.array([-1.9, 0.0, 0.0])
    line = I2cLine(100_000)
    line.attach(0x6A, device)
    torn = 0
    for k in range(200):
        start_ns = (20 + k) * MS + k * 31_000
        steps = line.transfer(0x6A, [I2cWrite(b"\x28"), I2cRead(2)], start_ns)
        try:
            while True:
                device.advance_to(next(steps))
        except StopIteration as done:
            data = done.value[1]
        end_g = -1.9 + 10.0 * (start_ns + line.duration_ns([I2cWrite(b"x"), I2cRead(2)])) * 1e-9
        torn += words(data, "little")[0] * 61e-6 > end_g  # an old low byte under a new high one is ahead of its time
    return torn


def test_block_data_update_keeps_the_halves_together() -> None:
    assert torn_pairs(0x44) == 0
    assert torn_pairs(0x04) > 0  # and without it they do come apart


def test_no_auto_increment_without_if_inc() -> None:
    device, _ = make()
    put(device, 0x12, 0x00, t_ns=0)
    assert get(device, 0x0F, 0, 3) == b"\x69\x69\x69"


def test_software_reset_and_boot() -> None:
    device, _ = running()
    put(device, 0x12, 0x01, t_ns=MS)
    assert get(device, 0x12, MS + 10_000)[0] & 1
    assert get(device, 0x12, MS + 50_000) == b"\x04"
    assert get(device, 0x10, MS + 50_000) == b"\0"
    put(device, 0x12, 0x80, t_ns=2 * MS)
    assert get(device, 0x12, 16 * MS)[0] & 0x80
    assert get(device, 0x12, 17 * MS) == b"\x04"


def test_self_test_within_the_data_sheet() -> None:
    """Table 3: 90 to 1700 mg; 20 to 80 dps at 245 dps, 150 to 700 dps at 2000 dps. Both signs."""
    device, _ = running()
    plain = np.array(words(get(device, 0x28, 600 * MS, 6), "little"))
    gyro = np.array(words(get(device, 0x22, 600 * MS, 6), "little"))
    put(device, 0x14, 0x05, t_ns=600 * MS)
    mg = (np.array(words(get(device, 0x28, 800 * MS, 6), "little")) - plain) * 0.061
    dps = (np.array(words(get(device, 0x22, 800 * MS, 6), "little")) - gyro) * 8.75e-3
    assert np.all((mg > 90) & (mg < 1700))
    assert np.all((dps > 20) & (dps < 80))
    put(device, 0x14, 0x0E, t_ns=800 * MS)
    put(device, 0x11, 0x4C, t_ns=800 * MS)
    assert np.all((np.array(words(get(device, 0x28, 900 * MS, 6), "little")) - plain) * 0.061 < -90)
    strong = np.array(words(get(device, 0x22, 900 * MS, 6), "little")) * 70e-3
    assert np.all((strong < -150) & (strong > -700))


def test_fifo_pattern_order_and_wrap() -> None:
    """Gyroscope x y z then accelerometer x y z; DIFF_FIFO counts words; 3Eh/3Fh wrap in a burst (AN4650, 8)."""
    device, stand = running()
    stand.dps = np.array([8.75, 17.5, 26.25])
    put(device, 0x08, 0x09, t_ns=580 * MS)  # no decimation
    put(device, 0x0A, 0x26, t_ns=580 * MS)  # 104 Hz, continuous
    t_ns = 600 * MS
    status = get(device, 0x3A, t_ns, 4)
    assert status[0] | (status[1] & 0x0F) << 8 == 12
    assert not status[1] & 0x10
    assert status[2:] == b"\0\0"
    frame = words(get(device, 0x3E, t_ns, 12), "little")
    assert frame == [1000, 2000, 3000, 0, 0, 16393]
    get(device, 0x3E, t_ns, 2)
    assert get(device, 0x3C, t_ns) == b"\x01"  # next word is the gyroscope's y
    get(device, 0x3E, t_ns, 10)
    assert get(device, 0x3B, t_ns) == b"\x10"  # empty


def test_fifo_decimation() -> None:
    device, _ = running()
    put(device, 0x08, 0x02 | 0x01 << 3, t_ns=0)  # accelerometer each second set
    put(device, 0x0A, 0x26, t_ns=0)
    device.advance_to(1000 * MS)
    assert len(device.fifo) == 104 * 3 + 52 * 3


def test_fifo_overrun_and_stop_when_full() -> None:
    device, _ = running(xl=0x80, g=0x80)
    put(device, 0x08, 0x09, t_ns=0)
    put(device, 0x0A, 0x46, t_ns=0)  # 1.66 kHz, continuous
    device.advance_to(450 * MS)
    assert get(device, 0x3B, 450 * MS)[0] & 0x60 == 0x60
    assert len(device.fifo) == 4095
    put(device, 0x0A, 0x00, t_ns=450 * MS)  # bypass empties
    assert get(device, 0x3A, 450 * MS, 2) == b"\x00\x10"
    put(device, 0x0A, 0x41, t_ns=450 * MS)
    device.advance_to(1000 * MS)
    assert get(device, 0x3B, 1000 * MS)[0] & 0x60 == 0x20  # full, nothing overwritten


def test_threshold_flag() -> None:
    device, _ = running()
    put(device, 0x06, 12, 0, 0x09, t_ns=0)
    put(device, 0x0A, 0x26, t_ns=0)
    assert get(device, 0x3B, 10 * MS)[0] & 0x80 == 0
    assert get(device, 0x3B, 20 * MS)[0] & 0x80


def test_gyroscope_turn_on_takes_80_ms() -> None:
    device, _ = running()
    assert abs(words(get(device, 0x22, 15 * MS, 2), "little")[0]) * 8.75e-3 > 1.0
    assert abs(words(get(device, 0x22, 120 * MS, 2), "little")[0]) * 8.75e-3 < 0.05
