"""MPU-6050 byte by byte against RM-MPU-6000A-00 rev 4.2 (sections named) and PS-MPU-6000A-00."""

from __future__ import annotations

import math

import numpy as np
import pytest

from drivers.imu.base import ImuBlock, ImuOffsets, ImuSample, PowerMode
from drivers.imu.mpu6050 import Mpu6050, factory_trim
from hal.clock import VirtualClock
from hal.errors import BenchError, HalTimeout, I2cNack, ProtocolError, WrongDevice
from hal.types import Status, TimeSource
from tests.wire.drivers.scripted_ports import ScriptedI2c

G = 9.80665
DEG = math.pi / 180.0
Step = tuple[int, object]


def w(data: str, address: int = 0x68) -> Step:
    return (address, [("w", bytes.fromhex(data))])


def r(register: str, answer: str, address: int = 0x68) -> Step:
    return (address, [("w", bytes.fromhex(register)), ("r", bytes.fromhex(answer))])


# 4.28: DEVICE_RESET is bit 7 and clears itself; 0x40 afterwards: asleep. Then the factory's trim, 0x06 .. 0x0B
RESET = [w("6b80"), r("6b", "c0"), r("6b", "40"), r("06", "0101fe00 1235")]
# 4.2 divider 9 (100 Hz), 4.3 DLPF 3 (44/42 Hz), 4.4 FS_SEL 3 (2000 deg/s), 4.5 AFS_SEL 1 (4 g)
CONFIGURE = [w("19 09 03 18 08"), r("19", "09 03 18 08")]
# 4.28 awake on the gyro's clock, 4.29 nothing in standby; 4.15 DATA_RDY_EN; 4.16 ready; FIFO off, 4.27 FIFO_RESET
START = [w("6b 01 00"), w("38 01"), r("3a", "00"), r("3a", "01"), w("23 00"), w("6a 04")]
# the same with all sensors into the FIFO: 4.15 FIFO_OFLOW_EN too, 4.6 all five, 4.27 FIFO_RESET then FIFO_EN
START_FIFO = [w("6b 01 00"), w("38 11"), r("3a", "01"), w("23 f8"), w("6a 04"), w("6a 40")]


def make(*script: Step, address: int = 0x68) -> tuple[Mpu6050, ScriptedI2c, VirtualClock]:
    clock = VirtualClock()
    bus = ScriptedI2c(script)
    return Mpu6050(bus, clock, address), bus, clock


def running(*script: Step, fifo: bool = False) -> tuple[Mpu6050, ScriptedI2c, VirtualClock]:
    imu, bus, clock = make(*RESET, *CONFIGURE, *(START_FIFO if fifo else START), *script)
    imu.reset()
    imu.configure(rate_hz=100, accel_range_g=4, gyro_range_dps=2000)
    imu.start("fifo" if fifo else "data ready")
    return imu, bus, clock


@pytest.mark.parametrize("address", [0x68, 0x69])
def test_identity_is_0x68_at_either_address(address: int):
    imu, bus, _ = make(r("75", "68", address), address=address)  # 4.32
    assert imu.probe() == f"MPU-6050 at 0x{address:02X}"
    bus.done()


def test_another_part_at_this_address_is_refused():
    imu, _, _ = make(r("75", "0f"))
    with pytest.raises(WrongDevice, match=r"imu: WHO_AM_I at address 0x68 reads 0x0F"):
        imu.probe()


def test_reset_waits_for_its_bit_and_not_longer_than_told():
    imu, bus, clock = make(*RESET)
    imu.reset()
    assert clock.now_ns() == 1_000_000
    bus.done()
    imu, _, clock = make(w("6b80"), *[r("6b", "c0")] * 11)
    with pytest.raises(HalTimeout, match=r"reset not done after 0.01 s"):
        imu.reset(limit_s=0.01)
    assert clock.now_ns() == 10_000_000


def test_no_acknowledge_during_reset_is_not_yet():
    imu, bus, _ = make(w("6b80"), (0x68, I2cNack("busy")), r("6b", "40"), r("06", "00" * 6))
    imu.reset()
    bus.done()


def test_configuration_says_what_the_chip_does():
    imu, bus, _ = make(*CONFIGURE)
    setup = imu.configure(rate_hz=100, accel_range_g=4, gyro_range_dps=2000)
    assert (setup.rate_hz, setup.accel_bandwidth_hz, setup.gyro_bandwidth_hz) == (100.0, 44.0, 42.0)
    assert setup.accel_lsb_mps2 == pytest.approx(G / 8192)  # 4.17
    assert setup.gyro_lsb_rad_s == pytest.approx(DEG / 16.4)  # 4.19
    bus.done()


@pytest.mark.parametrize(
    ("rate_hz", "bandwidth_hz", "data", "actual_hz"),
    [(1000, None, "00 01 00 00", 1000.0), (300, 20, "02 04 00 00", 1000 / 3), (5, 1, "c7 06 00 00", 5.0)],
)
def test_rates_and_filters(rate_hz: float, bandwidth_hz: float | None, data: str, actual_hz: float):
    imu, bus, _ = make(w("19" + data), r("19", data))
    setup = imu.configure(rate_hz=rate_hz, accel_range_g=2, gyro_range_dps=250, bandwidth_hz=bandwidth_hz)
    assert setup.rate_hz == pytest.approx(actual_hz)
    bus.done()


def test_settings_that_do_not_read_back_are_an_error():
    imu, _, _ = make(w("19 09 03 18 08"), r("19", "09 03 00 08"))
    with pytest.raises(ProtocolError, match="SMPLRT_DIV"):
        imu.configure(rate_hz=100, accel_range_g=4, gyro_range_dps=2000)


@pytest.mark.parametrize(
    "wish",
    [
        {"rate_hz": 3.0, "accel_range_g": 2, "gyro_range_dps": 250},
        {"rate_hz": 2000.0, "accel_range_g": 2, "gyro_range_dps": 250},
        {"rate_hz": 0.0, "accel_range_g": 2, "gyro_range_dps": 250},
        {"rate_hz": 100.0, "accel_range_g": 3, "gyro_range_dps": 250},
        {"rate_hz": 100.0, "accel_range_g": 2, "gyro_range_dps": 125},
    ],
)
def test_impossible_wishes_touch_no_wire(wish: dict[str, float]):
    imu, _, _ = make()
    with pytest.raises(BenchError):
        imu.configure(**wish)


def test_wrong_order_and_wrong_address():
    imu, _, _ = make()
    with pytest.raises(BenchError, match="start before configure"):
        imu.start()
    with pytest.raises(BenchError, match="AD0"):
        Mpu6050(ScriptedI2c([]), VirtualClock(), 0x6A)
    with pytest.raises(BenchError, match="needs start"):
        imu.read(ImuSample())


def test_one_burst_is_one_sample():
    # 4.16-4.19: INT_STATUS, then big-endian accelerometer, temperature, gyro
    imu, bus, clock = running(r("3a", "01 2000 e000 0001 f1a0 0148 feb8 0000"))
    clock.burn_ns(10_000_000)
    out = ImuSample()
    assert imu.read(out) is Status.OK
    assert out.accel_mps2 == pytest.approx([G, -G, G / 8192])
    assert out.gyro_rad_s == pytest.approx([20 * DEG, -20 * DEG, 0.0])
    assert out.temperature_C == pytest.approx(-3680 / 340 + 36.53)  # 4.18
    assert out.raw.tolist() == [8192, -8192, 1, 328, -328, 0, -3680]
    assert (out.t_ns, out.seq, out.lost, out.source) == (clock.now_ns(), 0, 0, TimeSource.HOST)
    assert np.isnan(out.field_T).all()
    bus.done()


def test_old_data_are_stale_and_lost_data_counted():
    old, new = r("3a", "00" + "0001" * 7), r("3a", "01" + "0001" * 7)
    imu, bus, clock = running(new, old, new, new)
    out = ImuSample()
    seen: list[tuple[int, Status, int, int]] = []
    for wait_ms in (0, 1, 9, 35):  # 100 Hz: 35 ms later at least floor(3.5) samples were made
        clock.burn_ns(wait_ms * 1_000_000)
        seen.append((out.t_ns, imu.read(out), out.seq, out.lost))
    assert [s[1:] for s in seen] == [
        (Status.OK, 0, 0),
        (Status.STALE, 0, 0),
        (Status.OK, 1, 0),
        (Status.OVERRUN, 4, 2),
    ]
    assert (imu.lost, imu.stale) == (2, 1)
    bus.done()


def test_full_scale_is_saturation():
    imu, _, _ = running(r("3a", "01 7fff" + "0000" * 6), r("3a", "01" + "0000" * 6 + "8000"))
    out = ImuSample()
    assert imu.read(out) is Status.SATURATED
    assert imu.read(out) is Status.SATURATED


def test_silent_chip_does_not_start():
    imu, _, clock = make(*CONFIGURE, w("6b 01 00"), w("38 01"), *[r("3a", "00")] * 6)
    imu.configure(rate_hz=100, accel_range_g=4, gyro_range_dps=2000)
    with pytest.raises(HalTimeout, match=r"first sample not done after 0.005 s"):
        imu.start(limit_s=0.005)
    assert clock.now_ns() == 30_000_000 + 5_000_000  # PS 6.1: gyro start-up


def test_fifo_frames_in_register_order():
    # 4.6: accelerometer, temperature, gyro; 4.30 count 30 = two frames and a begun one
    frame = "0001 0002 0003 f1a0 0004 0005 0006"
    imu, bus, clock = running(r("3a", "01"), r("72", "001e"), r("74", frame + "fff7" * 7), fifo=True)
    clock.burn_ns(20_000_000)
    out = ImuBlock(8)
    assert imu.read_fifo(out) == 2
    assert out.raw[:2].tolist() == [[1, 2, 3, 4, 5, 6], [-9] * 6]
    assert out.accel_mps2[0] == pytest.approx(np.array([1, 2, 3]) * G / 8192)
    assert out.gyro_rad_s[1] == pytest.approx([-9 * DEG / 16.4] * 3)
    assert (out.t0_ns, out.dt_ns) == (clock.now_ns() - 10_000_000, 10_000_000)
    assert (out.seq0, out.lost, out.status, out.source) == (0, 0, Status.OK, TimeSource.DEVICE_CLOCK)
    bus.done()


def test_what_does_not_fit_stays_for_the_next_time():
    script = [r("3a", "01"), r("72", "002a"), r("74", "0001" * 14), r("3a", "01"), r("72", "000e"), r("74", "0002" * 7)]
    imu, bus, clock = running(*script, fifo=True)
    clock.burn_ns(30_000_000)
    now_ns = clock.now_ns()
    out = ImuBlock(2)
    assert imu.read_fifo(out) == 2
    assert out.t0_ns == now_ns - 20_000_000  # the third was taken just now
    assert imu.read_fifo(out) == 1
    assert (out.t0_ns, out.seq0, out.lost) == (now_ns, 2, 0)
    bus.done()


def test_fifo_overflow_is_emptied_and_counted():
    script = [r("3a", "00"), r("72", "0000"), r("3a", "11"), r("72", "0400"), w("6a 04"), w("6a 40")]
    imu, bus, clock = running(*script, r("3a", "01"), r("72", "000e"), r("74", "0000" * 7), fifo=True)
    out = ImuBlock()
    assert imu.read_fifo(out) == 0
    assert out.status is Status.STALE
    clock.burn_ns(1_000_000_000)
    assert imu.read_fifo(out) == 0
    assert (out.status, out.lost) == (Status.OVERRUN, 100)  # 1 s at 100 Hz
    clock.burn_ns(10_000_000)
    assert imu.read_fifo(out) == 1
    assert (out.seq0, imu.lost) == (100, 100)
    bus.done()


def test_offsets_go_on_top_of_the_factory_trim():
    # factory: 0x0101, 0xFE00, 0x1235. 16 g scale: 1/1024 g per step of two counts, bit 0 kept. Gyro: 32.8 per deg/s
    imu, bus, _ = make(
        *RESET,
        w("06 0121 fdf0 1235"),
        r("06", "0121 fdf0 1235"),
        w("13 0042 ffbe 0000"),
        r("13", "0042 ffbe 0000"),
        r("06", "0121 fdf0 1235"),
        r("13", "0042 ffbe 0000"),
    )
    imu.reset()
    wanted = ImuOffsets((16 * G / 1024, -8 * G / 1024, 0.0), (2.0 * DEG, -2.0 * DEG, 0.0))
    kept = imu.write_offsets(wanted)
    assert kept.accel_mps2 == pytest.approx(wanted.accel_mps2)
    assert kept.gyro_rad_s == pytest.approx((66 / 32.8 * DEG, -66 / 32.8 * DEG, 0.0))
    bus.done()


def test_offsets_out_of_range_or_unknown_trim():
    imu, bus, _ = make(*RESET)
    with pytest.raises(BenchError, match="reset"):
        imu.write_offsets(ImuOffsets())
    imu.reset()
    with pytest.raises(BenchError, match="gyro offset of y"):
        imu.write_offsets(ImuOffsets(gyro_rad_s=(0.0, 1001 * DEG, 0.0)))
    bus.done()


def test_factory_trim_formulas():
    # 4.1, p. 9: XA_TEST = 0b10101 in 0x0D<7:5> and 0x10<5:4>; XG 1, YG 1, ZG 0; YA 31, ZA 1
    accel_x, accel_y, accel_z, x, y, z = factory_trim(bytes((0b101_00001, 0b111_00001, 0b000_00000, 0b00_01_11_01)))
    assert accel_x == pytest.approx(1392.64 * (0.92 / 0.34) ** (20 / 30))
    assert accel_y == pytest.approx(4096 * 0.92)
    assert accel_z == pytest.approx(4096 * 0.34)
    assert (x, y, z) == (pytest.approx(25 * 131), pytest.approx(-25 * 131), 0.0)


def test_self_test_against_the_trim_and_back_to_work():
    still = r("3b", "0000 0000 0000 0000 0000 0000 0000")
    # trim 4096 x 0.34 = 1392.64 counts and 3275 counts; z of the gyro answers 20 % too much
    forced = r("3b", "0571 0571 0571 0000 0ccb f335 0f5a")
    imu, bus, _ = running(
        w("6b 01 00"),
        w("19 00 02 00 10"),  # 4.5: AFS_SEL 2, 8 g
        r("19", "00 02 00 10"),
        *[still] * 20,
        w("19 00 02 e0 f0"),  # 4.4, 4.5: self-test of all axes
        r("19", "00 02 e0 f0"),
        *[forced] * 20,
        r("0d", "01 01 01 15"),
        *CONFIGURE,
        *START,
    )
    report = imu.self_test()
    assert [a.axis for a in report.axes] == ["accel_x", "accel_y", "accel_z", "gyro_x", "gyro_y", "gyro_z"]
    assert [a.passed for a in report.axes] == [True] * 5 + [False]
    assert report.axes[5].value == pytest.approx(100 * (3930 - 3275) / 3275)
    assert not report.passed
    bus.done()


@pytest.mark.parametrize(
    ("mode", "data"),
    [
        (PowerMode.NORMAL, "6b 01 00"),
        (PowerMode.SLEEP, "6b 41 00"),
        (PowerMode.ACCEL_ONLY, "6b 00 07"),
        (PowerMode.LOW_POWER, "6b 28 c7"),  # CYCLE, TEMP_DIS; 40 Hz, gyro in standby
    ],
)
def test_power_modes(mode: PowerMode, data: str):
    imu, bus, _ = make(w(data))
    imu.power(mode)
    bus.done()


def test_without_gyro_there_are_no_rates():
    imu, _, _ = running(w("6b 00 07"), r("3a", "01" + "0001" * 7))
    imu.power(PowerMode.ACCEL_ONLY)
    out = ImuSample()
    imu.read(out)
    assert np.isnan(out.gyro_rad_s).all()
    assert np.isfinite(out.accel_mps2).all()


def test_two_of_one_family_do_not_disturb_each_other():
    script = [
        w("19 00 01 00 00"),
        r("19", "00 01 00 00"),
        w("19 09 03 18 18", 0x69),
        r("19", "09 03 18 18", 0x69),
        *START,
        *[(0x69, ops) for _, ops in START],
        r("3a", "01 4000" + "0000" * 5 + "0083"),
        r("3a", "01 4000" + "0000" * 5 + "0083", 0x69),
    ]
    clock, bus = VirtualClock(), ScriptedI2c(script)
    one, other = Mpu6050(bus, clock, 0x68, name="one"), Mpu6050(bus, clock, 0x69, name="other")
    one.configure(rate_hz=1000, accel_range_g=2, gyro_range_dps=250)
    other.configure(rate_hz=100, accel_range_g=16, gyro_range_dps=2000)
    one.start()
    other.start()
    a, b = ImuSample(), ImuSample()
    one.read(a)
    other.read(b)
    assert a.accel_mps2[0] == pytest.approx(G)
    assert b.accel_mps2[0] == pytest.approx(8 * G)
    assert a.gyro_rad_s[2] == pytest.approx(DEG)
    assert b.gyro_rad_s[2] == pytest.approx(131 / 16.4 * DEG)
    bus.done()
