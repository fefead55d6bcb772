"""The emulated MPU-6050 against the register map (RM-MPU-6000A-00 rev. 4.2) and product specification (rev. 3.4)."""

from __future__ import annotations

import numpy as np
import pytest

from hal.types import I2cRead, I2cWrite
from sim_devices.devices.mpu6050 import Mpu6050
from sim_devices.plant.imu import MPU6050_SPEC
from sim_devices.transports.i2c_line import I2cLine, I2cStatus
from tests.wire.emulators.imu_stand import Stand, get, put, words

MS = 1_000_000


def make(**keywords: object) -> tuple[Mpu6050, Stand]:
    stand = Stand()
    return Mpu6050(stand.imu(MPU6050_SPEC), **keywords), stand  # type: ignore[arg-type]


def awake(divider: int = 9, dlpf: int = 3) -> tuple[Mpu6050, Stand]:
    """100 Hz with the 44 Hz filter, awake at 0."""
    device, stand = make()
    put(device, 0x19, divider, dlpf, t_ns=0)
    put(device, 0x6B, 0x00, t_ns=0)
    return device, stand


def test_reset_values() -> None:
    """RM 3: all 0x00 but PWR_MGMT_1 = 0x40 (asleep) and WHO_AM_I = 0x68; trim registers are the factory's."""
    device, _ = make()
    for register in range(0x76):
        if register in (0x6B, 0x75) or 0x06 <= register <= 0x10:
            continue
        assert get(device, register, 0) == b"\0", hex(register)
    assert get(device, 0x6B, 0) == b"\x40"
    assert get(device, 0x75, 0) == b"\x68"


def test_asleep_nothing_is_measured() -> None:
    device, _ = make()
    device.advance_to(1000 * MS)
    assert device.next_event_ns() is None
    assert get(device, 0x3B, 1000 * MS, 14) == bytes(14)
    assert device.samples == 0


@pytest.mark.parametrize("register", [0x75, 0x3A, 0x3B, 0x48, 0x0D, 0x72])
def test_read_only_registers(register: int) -> None:
    device, _ = make()
    before = get(device, register, 0)
    put(device, register, 0xA5, t_ns=0)
    assert get(device, register, 0) == before


@pytest.mark.parametrize(("register", "stays"), [(0x1A, 0x3F), (0x1B, 0xF8), (0x1C, 0xF8), (0x38, 0x59), (0x6B, 0x6F)])
def test_reserved_bits_read_zero(register: int, stays: int) -> None:
    device, _ = make()
    put(device, register, 0x7F if register == 0x6B else 0xFF, t_ns=0)
    assert get(device, register, 0)[0] == stays


def test_reset_takes_time_and_ends_asleep() -> None:
    device, _ = awake()
    put(device, 0x1B, 0x18, t_ns=0)
    put(device, 0x6B, 0x80, t_ns=10 * MS)
    assert get(device, 0x6B, 11 * MS)[0] & 0x80  # still at it
    put(device, 0x1B, 0x18, t_ns=11 * MS)  # lost
    assert get(device, 0x6B, 15 * MS) == b"\x40"
    assert get(device, 0x1B, 15 * MS) == b"\0"


@pytest.mark.parametrize(
    ("divider", "dlpf", "period_ns"),
    [(9, 3, 10 * MS), (0, 1, MS), (4, 6, 5 * MS), (7, 0, MS), (0, 7, 125_000), (255, 2, 256 * MS)],
)
def test_sample_rate(divider: int, dlpf: int, period_ns: int) -> None:
    """RM 4.2: gyroscope output rate (8 kHz with DLPF_CFG 0 or 7, else 1 kHz) / (1 + SMPLRT_DIV)."""
    device, _ = awake(divider, dlpf)
    device.advance_to(4 * period_ns - 1)
    assert device.samples == 3
    device.advance_to(4 * period_ns)
    assert device.samples == 4


@pytest.mark.parametrize(
    ("fs", "lsb_per_g", "lsb_per_dps"), [(0, 16384, 131), (1, 8192, 65.5), (2, 4096, 32.8), (3, 2048, 16.4)]
)
def test_scales_and_temperature(fs: int, lsb_per_g: float, lsb_per_dps: float) -> None:
    """RM 4.17 to 4.19; registers big-endian from 0x3B: accelerometer, temperature, gyroscope."""
    device, stand = awake()
    put(device, 0x1B, fs << 3, fs << 3, t_ns=0)
    stand.g, stand.dps, stand.temperature_C = np.array([0.25, -0.5, 1.0]), np.array([10.0, -20.0, 100.0]), 36.53
    t_ns = 400 * MS
    values = words(get(device, 0x3B, t_ns, 14))
    assert values[:3] == [round(v * lsb_per_g) for v in (0.25, -0.5, 1.0)]
    assert values[3] == 0
    assert values[4:] == [round(v * lsb_per_dps) for v in (10.0, -20.0, 100.0)]
    stand.temperature_C = 26.53
    assert words(get(device, 0x41, t_ns + 10 * MS, 2)) == [-3400]  # degC = counts / 340 + 36.53


def test_saturates_at_full_scale() -> None:
    device, stand = awake()
    stand.g, stand.dps = np.array([3.0, -3.0, 0.0]), np.array([300.0, -300.0, 0.0])
    values = words(get(device, 0x3B, 400 * MS, 14))
    assert values[:2] == [32767, -32768]
    assert values[4:6] == [32767, -32768]


def test_data_ready_needs_its_enable_and_clears_on_reading_the_status_only() -> None:
    device, _ = awake()
    assert get(device, 0x3A, 15 * MS)[0] & 1 == 0
    put(device, 0x38, 0x01, t_ns=15 * MS)
    assert get(device, 0x3A, 19 * MS) == b"\0"
    get(device, 0x3B, 21 * MS, 14)  # reading data leaves the flag
    assert device.interrupt
    assert get(device, 0x3A, 21 * MS) == b"\x01"
    assert get(device, 0x3A, 22 * MS) == b"\0"
    assert get(device, 0x3A, 30 * MS) == b"\x01"


def test_int_rd_clear_any_read() -> None:
    device, _ = awake()
    put(device, 0x37, 0x30, 0x01, t_ns=0)
    device.advance_to(10 * MS)
    get(device, 0x75, 11 * MS)
    assert get(device, 0x3A, 12 * MS) == b"\0"


def test_burst_is_one_instant_even_when_a_sample_falls_into_it() -> None:
    """14 bytes at 100 kHz take 1.5 ms, longer than a sample period of 1 ms."""
    device, stand = awake(divider=0, dlpf=1)
    stand.ramp_g = np.array([0.5, 0.5, 0.0])
    line = I2cLine(100_000)
    line.attach(0x68, device)
    equal = 0
    for k in range(20):
        steps = line.transfer(0x68, [I2cWrite(b"\x3b"), I2cRead(14)], (100 + 7 * k) * MS + k * 50_000)
        try:
            while True:
                device.advance_to(next(steps))
        except StopIteration as done:
            status, data = done.value
        assert status is I2cStatus.OK
        x, y = words(data)[:2]
        equal += x == y
    assert equal == 20


def test_fifo_order_count_and_repeat_of_the_last_byte() -> None:
    """RM 4.12, 4.30, 4.31: frames in register order, count in bytes, an empty FIFO repeats its last byte."""
    device, stand = awake()
    stand.dps = np.array([1.0, 2.0, 3.0])
    put(device, 0x23, 0xF8, t_ns=395 * MS)  # temperature, gyroscope x y z, accelerometer
    put(device, 0x6A, 0x40, t_ns=395 * MS)
    assert get(device, 0x72, 425 * MS, 2) == (42).to_bytes(2, "big")
    frame = get(device, 0x74, 425 * MS, 14)
    assert words(frame)[:3] == [0, 0, 16384]
    assert words(frame)[4:] == [131, 262, 393]
    get(device, 0x74, 425 * MS, 28)
    assert get(device, 0x72, 425 * MS, 2) == b"\0\0"
    assert get(device, 0x74, 425 * MS, 3) == bytes([393 & 0xFF] * 3)


def test_fifo_count_low_byte_is_latched_by_the_high_byte() -> None:
    device, _ = awake()
    put(device, 0x23, 0x08, t_ns=0)
    put(device, 0x6A, 0x40, t_ns=0)
    get(device, 0x72, 10 * MS)
    assert get(device, 0x73, 30 * MS) == b"\x06"
    assert get(device, 0x72, 30 * MS, 2) == b"\x00\x12"


def test_fifo_overflow_loses_the_oldest_and_says_so() -> None:
    device, _ = awake(divider=0, dlpf=1)
    put(device, 0x38, 0x10, t_ns=0)
    put(device, 0x23, 0x78, t_ns=0)
    put(device, 0x6A, 0x40, t_ns=0)
    assert get(device, 0x3A, 85 * MS) == b"\0"  # 85 x 12 = 1020 bytes
    assert get(device, 0x3A, 86 * MS) == b"\x10"
    assert get(device, 0x72, 86 * MS, 2) == (1024).to_bytes(2, "big")
    put(device, 0x6A, 0x44, t_ns=86 * MS)  # FIFO_RESET while enabled does nothing
    assert get(device, 0x72, 86 * MS, 2) == (1024).to_bytes(2, "big")
    put(device, 0x6A, 0x04, t_ns=86 * MS)
    assert get(device, 0x6A, 86 * MS) == b"\0"  # clears itself
    put(device, 0x6A, 0x40, t_ns=86 * MS)
    assert get(device, 0x72, 86 * MS, 2) == b"\0\0"


def test_self_test_response_is_the_factory_trim() -> None:
    """RM 4.1: response = output with minus output without; codes in 0x0D to 0x10 give the factory's."""
    device, _ = awake()
    put(device, 0x1C, 0x10, t_ns=0)  # +-8 g, 4096 LSB/g; gyroscope at +-250 dps, 131 LSB/dps
    plain = words(get(device, 0x3B, 400 * MS, 14))
    put(device, 0x1B, 0xE0, 0xF0, t_ns=400 * MS)
    tested = words(get(device, 0x3B, 600 * MS, 14))
    x, y, z, a = get(device, 0x0D, 0, 4)
    for axis, register in enumerate((x, y, z)):
        accel_code = register >> 5 << 2 | a >> 4 - 2 * axis & 3
        gyro_code = register & 0x1F
        factory = 4096 * 0.34 * (0.92 / 0.34) ** ((accel_code - 1) / 30)
        assert tested[axis] - plain[axis] == pytest.approx(factory, rel=0.01)
        sign = -1 if axis == 1 else 1
        assert tested[4 + axis] - plain[4 + axis] == pytest.approx(sign * 25 * 131 * 1.046 ** (gyro_code - 1), rel=0.01)


def test_offset_registers_act_in_their_own_scale() -> None:
    """Gyroscope at +-1000 dps (32.8 LSB/dps), accelerometer at +-16 g (2048 LSB/g, 0.98 mg for bit 1) from the trim."""
    device, _ = awake()
    trim = words(get(device, 0x06, 0, 6))
    assert trim == [-1320, 846, 1788]
    put(device, 0x06, *((trim[0] + 410) & 0xFFFF).to_bytes(2, "big"), t_ns=0)
    put(device, 0x13, *(-328 & 0xFFFF).to_bytes(2, "big"), t_ns=0)
    values = words(get(device, 0x3B, 400 * MS, 14))
    assert values[0] == pytest.approx(410 / 2048 * 16384, abs=1)
    assert values[4] == -1310
    put(device, 0x6B, 0x80, t_ns=400 * MS)
    assert words(get(device, 0x06, 410 * MS, 6)) == trim  # a reset brings the factory's back


def test_gyroscope_needs_its_time_after_waking() -> None:
    device, _ = awake()
    assert abs(words(get(device, 0x43, 10 * MS, 2))[0]) > 131
    assert abs(words(get(device, 0x43, 70 * MS, 2))[0]) <= 1


def test_standby_keeps_the_last_value() -> None:
    device, stand = awake()
    put(device, 0x6C, 0x07, t_ns=395 * MS)  # gyroscope off
    before = get(device, 0x43, 399 * MS, 6)
    stand.dps = np.array([50.0, 50.0, 50.0])
    assert get(device, 0x43, 600 * MS, 6) == before


def test_noise_is_density_times_root_bandwidth() -> None:
    """Errata no. 114: 0.005 dps/rtHz x sqrt(42 Hz) = 0.0324 dps; 0.4 mg/rtHz x sqrt(44 Hz) = 2.65 mg."""
    stand = Stand()
    device = Mpu6050(stand.imu(MPU6050_SPEC, noise=1.0))
    put(device, 0x19, 49, 3, t_ns=0)
    put(device, 0x6B, 0x00, t_ns=0)
    rows = [words(get(device, 0x3B, (400 + 50 * k) * MS, 14)) for k in range(600)]
    counts = np.array(rows, dtype=float)
    wander = counts[:, 4] - np.convolve(counts[:, 4], np.full(9, 1 / 9), "same")
    assert np.std(wander[5:-5]) / 131 * np.sqrt(9 / 8) == pytest.approx(0.0324, rel=0.12)
    assert np.std(counts[:, 0]) / 16.384 == pytest.approx(2.65, rel=0.1)


def test_nack_and_freeze_hooks() -> None:
    device, _ = awake()
    device.nack_address = True
    assert not device.acknowledges()
    device.nack_data = True
    assert device.write(b"\x6b\x00", 0) == 0
    device.nack_data, device.frozen = False, True
    device.advance_to(100 * MS)
    assert device.samples == 0
    assert device.next_event_ns() is None


def test_clock_error() -> None:
    device, _ = make(rate_error=0.01)
    put(device, 0x19, 0, 1, t_ns=0)
    put(device, 0x6B, 0, t_ns=0)
    device.advance_to(1000 * MS)
    assert device.samples == 1010
    with pytest.raises(ValueError, match="1 %"):
        make(rate_error=0.02)
