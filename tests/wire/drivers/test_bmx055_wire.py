"""BMX055 byte by byte against BST-BMX055-DS000 rev 1.1 (die and register address named)."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest

from drivers.imu.base import ImuBlock, ImuOffsets, ImuSample, PowerMode
from drivers.imu.bmx055 import Bmx055
from hal.clock import VirtualClock
from hal.errors import BenchError, HalTimeout, WrongDevice
from hal.types import Status
from tests.wire.drivers.scripted_ports import ScriptedI2c

G = 9.80665
DEG = math.pi / 180.0
ACC, GYR, MAG = 0x18, 0x68, 0x10
Step = tuple[int, object]


def w(die: int, data: str) -> Step:
    return (die, [("w", bytes.fromhex(data))])


def r(die: int, register: str, answer: str) -> Step:
    return (die, [("w", bytes.fromhex(register)), ("r", bytes.fromhex(answer))])


def field(die: int, register: str, before: str, after: str) -> list[Step]:
    """Read, change, read back."""
    return [r(die, register, before), w(die, register + after), r(die, register, after)]


# ACC 0x0F: 4 g = 0101; ACC 0x10: 62.5 Hz (125 per second) = 01011; GYR 0x0F: 500 deg/s = 010; GYR 0x10: 100/32 = 0111
CONFIGURE = [
    *field(ACC, "0f", "03", "05"),
    *field(ACC, "10", "0f", "0b"),
    *field(GYR, "0f", "80", "82"),
    *field(GYR, "10", "80", "87"),
]
STREAM = [w(ACC, "3e 80"), w(GYR, "3e 80")]  # FIFO_CONFIG_1: mode 10
NORMAL = [w(ACC, "11 00"), w(GYR, "11 00")]
START = [*NORMAL, *STREAM, r(ACC, "0e", "00"), r(ACC, "0e", "01"), r(GYR, "0e", "01"), *STREAM]


def make(*script: Step, mag_rate_hz: float = 0) -> tuple[Bmx055, ScriptedI2c, VirtualClock]:
    clock = VirtualClock()
    bus = ScriptedI2c(script)
    return Bmx055(bus, clock, mag_rate_hz=mag_rate_hz), bus, clock


def running(*script: Step, fifo: bool = False) -> tuple[Bmx055, ScriptedI2c, VirtualClock]:
    imu, bus, clock = make(*CONFIGURE, *START, *script)
    imu.configure(rate_hz=100, accel_range_g=4, gyro_range_dps=500)
    imu.start("fifo" if fifo else "data ready")
    return imu, bus, clock


def heads(n_accel: int, n_gyro: int, temperature: str = "04") -> list[Step]:
    """ACC 0x08 .. 0x0E (temperature first, FIFO_STATUS last) and GYR 0x0E."""
    return [r(ACC, "08", f"{temperature} 0000000000 {n_accel:02x}"), r(GYR, "0e", f"{n_gyro:02x}")]


def accel(*rows: tuple[int, int, int]) -> Step:
    return r(ACC, "3f", b"".join(struct.pack("<3h", *(v << 4 for v in row)) for row in rows).hex())


def gyro(*rows: tuple[int, int, int]) -> Step:
    return r(GYR, "3f", b"".join(struct.pack("<3h", *row) for row in rows).hex())


def test_identity_of_three_dies():
    script = [r(ACC, "00", "fa"), r(GYR, "00", "0f"), w(MAG, "4b 01"), r(MAG, "40", "32")]
    imu, bus, clock = make(*script, mag_rate_hz=10)
    assert imu.probe() == "BMX055 at 0x18, 0x68, 0x10"
    assert clock.now_ns() == 3_000_000  # suspend to sleep
    bus.done()


def test_an_mpu6050_is_no_gyro_of_a_bmx055():
    imu, _, _ = make(r(ACC, "00", "fa"), r(GYR, "00", "68"))
    with pytest.raises(WrongDevice, match=r"imu gyro: CHIP_ID at address 0x68 reads 0x68, BMX055 says 0x0F"):
        imu.probe()


@pytest.mark.parametrize(
    ("addresses", "words"),
    [
        ({"address": 0x1A}, "accelerometer"),
        ({"gyro_address": 0x6A}, "gyro"),
        ({"gyro_address": 0x69}, "SDO2"),
        ({"mag_address": 0x14}, "magnetometer"),
        ({"mag_rate_hz": 5}, "mag_rate_hz"),
    ],
)
def test_straps_that_do_not_exist(addresses: dict[str, int], words: str):
    with pytest.raises(BenchError, match=words):
        Bmx055(ScriptedI2c([]), VirtualClock(), **addresses)


def test_soft_reset_of_all_dies():
    imu, bus, _ = make(
        w(ACC, "14 b6"),
        w(GYR, "14 b6"),
        r(ACC, "00", "fa"),
        r(GYR, "00", "00"),
        r(GYR, "00", "0f"),
        w(MAG, "4b 83"),  # both reset bits and the power bit
        r(MAG, "40", "32"),
        mag_rate_hz=10,
    )
    imu.reset()
    bus.done()


def test_configuration_says_what_the_dies_do():
    imu, bus, _ = make(*CONFIGURE)
    setup = imu.configure(rate_hz=100, accel_range_g=4, gyro_range_dps=500)
    assert (setup.rate_hz, setup.accel_bandwidth_hz, setup.gyro_bandwidth_hz) == (100.0, 62.5, 32.0)
    assert setup.accel_lsb_mps2 == pytest.approx(G / 512)
    assert setup.gyro_lsb_rad_s == pytest.approx(DEG / 65.6)
    bus.done()


@pytest.mark.parametrize(
    ("range_g", "code", "dps", "gyro_code", "rate_hz", "bandwidths"),
    [
        (2, "03", 2000, "80", 1000, ("0e", "82")),
        (8, "08", 1000, "81", 2000, ("0f", "80")),
        (16, "0c", 125, "84", 400, ("0d", "83")),
    ],
)
def test_codes(range_g: float, code: str, dps: float, gyro_code: str, rate_hz: float, bandwidths: tuple[str, str]):
    imu, bus, _ = make(
        *field(ACC, "0f", "03", code),
        *field(ACC, "10", "0f", bandwidths[0]),
        *field(GYR, "0f", "80", gyro_code),
        *field(GYR, "10", "80", bandwidths[1]),
    )
    imu.configure(rate_hz=rate_hz, accel_range_g=range_g, gyro_range_dps=dps, bandwidth_hz=1000)
    bus.done()


def test_newest_frames_make_a_sample():
    imu, bus, clock = running(*heads(1, 1), accel((512, -512, 1)), gyro((656, -656, 2)))
    clock.burn_ns(10_000_000)
    out = ImuSample()
    assert imu.read(out) is Status.OK
    assert out.accel_mps2 == pytest.approx([G, -G, G / 512])
    assert out.gyro_rad_s == pytest.approx([10 * DEG, -10 * DEG, 2 / 65.6 * DEG])
    assert out.temperature_C == 25.0  # ACC 0x08: 23 degC + 4 x 0.5 K
    assert out.raw.tolist() == [512, -512, 1, 656, -656, 2, 4]
    assert (out.t_ns, out.seq, out.lost) == (clock.now_ns(), 0, 0)
    bus.done()


def test_nothing_new_is_stale_and_what_was_not_read_is_lost():
    script = [*heads(1, 1), accel((1, 2, 3)), gyro((4, 5, 6)), *heads(1, 0)]
    script += [*heads(3, 3), accel((7, 7, 7), (8, 8, 8), (9, 9, 9)), gyro((1, 1, 1), (2, 2, 2), (3, 3, 3))]
    imu, bus, clock = running(*script)
    out = ImuSample()
    imu.read(out)
    t_ns = out.t_ns
    clock.burn_ns(1_000_000)
    assert imu.read(out) is Status.STALE
    assert (out.raw[:6].tolist(), out.t_ns, out.seq) == ([1, 2, 3, 4, 5, 6], t_ns, 0)
    assert imu.read(out) is Status.OVERRUN
    assert (out.raw[:6].tolist(), out.seq, out.lost) == ([9, 9, 9, 3, 3, 3], 3, 2)
    assert (imu.lost, imu.stale) == (2, 1)
    bus.done()


def test_a_gyro_frame_without_a_new_accelerometer_frame_keeps_the_last():
    imu, bus, _ = running(*heads(1, 1), accel((1, 2, 3)), gyro((4, 5, 6)), *heads(0, 1), gyro((7, 8, 9)))
    out = ImuSample()
    imu.read(out)
    assert imu.read(out) is Status.OK
    assert out.raw[:6].tolist() == [1, 2, 3, 7, 8, 9]
    bus.done()


def test_fifo_pairs_frames_nearest_in_time():
    # five accelerometer frames in the time of four of the gyro: 1/8, 3/8, 5/8, 7/8 of the way are frames 0, 1, 3, 4
    rows = [(i, i, i) for i in range(5)]
    imu, bus, clock = running(*heads(5, 4), accel(*rows), gyro(*[(10 * i,) * 3 for i in range(4)]), fifo=True)
    clock.burn_ns(40_000_000)
    out = ImuBlock(8)
    assert imu.read_fifo(out) == 4
    assert out.raw[:4, 0].tolist() == [0, 1, 3, 4]
    assert out.raw[:4, 3].tolist() == [0, 10, 20, 30]
    assert out.accel_mps2[3] == pytest.approx([4 * G / 512] * 3)
    assert out.gyro_rad_s[3] == pytest.approx([30 / 65.6 * DEG] * 3)
    assert (out.t0_ns, out.dt_ns) == (clock.now_ns() - 30_000_000, 10_000_000)
    bus.done()


def test_fifo_overrun_flag_is_cleared_by_writing_the_configuration():
    script = [*heads(0, 0), *heads(0x81, 0x81), accel((1, 1, 1)), gyro((1, 1, 1)), *STREAM]
    imu, bus, clock = running(*script, fifo=True)
    out = ImuBlock()
    imu.read_fifo(out)
    clock.burn_ns(500_000_000)
    assert imu.read_fifo(out) == 1
    assert (out.status, out.lost, imu.overruns) == (Status.OVERRUN, 49, 1)  # 50 periods
    bus.done()


@pytest.mark.parametrize("row", [((2047, 0, 0), (0, 0, 0)), ((0, -2048, 0), (0, 0, 0)), ((0, 0, 0), (0, 0, 32767))])
def test_full_scale_is_saturation(row: tuple[tuple[int, int, int], tuple[int, int, int]]):
    imu, _, _ = running(*heads(1, 1), accel(row[0]), gyro(row[1]))
    assert imu.read(ImuSample()) is Status.SATURATED


def test_silent_die_does_not_start():
    imu, _, clock = make(*CONFIGURE, *NORMAL, *STREAM, r(ACC, "0e", "01"), *[r(GYR, "0e", "00")] * 4)
    imu.configure(rate_hz=100, accel_range_g=4, gyro_range_dps=500)
    with pytest.raises(HalTimeout, match=r"imu gyro: no first sample"):
        imu.start(limit_s=0.003)
    assert clock.now_ns() == 33_000_000


def test_offset_registers_of_both_dies():
    # accelerometer: +3 and -2 steps of 7.8125 mg. Gyro: x = +0x123, y = -1, z = +5 steps of 125/2048 deg/s:
    # OFC1 x<3:2> = 00, y<3:1> = 111, z<3:1> = 010; OFC2 0x12, OFC3 0xFF, OFC4 0x00; TRIM_GP0 x<1:0> 11, y 1, z 1
    step, dps = G / 128, 125 / 2048 * DEG
    wanted = ImuOffsets((3 * step, -2 * step, 0.0), (0x123 * dps, -dps, 5 * dps))
    imu, bus, _ = make(
        w(ACC, "38 03fe00"),
        r(ACC, "38", "03fe00"),
        w(GYR, "36 3a 12 ff 00"),
        r(GYR, "36", "3a 12 ff 00"),
        *field(GYR, "3a", "a0", "af"),
        r(ACC, "38", "03fe00"),
        r(GYR, "36", "3a 12 ff 00"),
        r(GYR, "3a", "af"),
    )
    kept = imu.write_offsets(wanted)
    assert kept.accel_mps2 == pytest.approx(wanted.accel_mps2)
    assert kept.gyro_rad_s == pytest.approx(wanted.gyro_rad_s)
    bus.done()


def test_offset_beyond_one_g_is_refused_before_anything_is_written():
    imu, _, _ = make()
    with pytest.raises(BenchError, match=r"accelerometer offset of z is 132 steps"):
        imu.write_offsets(ImuOffsets(accel_mps2=(0.0, 0.0, 132 * G / 128)))


def test_self_test_of_three_dies():
    def deflected(test: str, counts_xyz: tuple[int, int, int]) -> list[Step]:
        data = struct.pack("<3h", *(c << 4 for c in counts_xyz)).hex()
        return [w(ACC, "32" + test), r(ACC, "02", data)]

    imu, bus, _ = make(
        *CONFIGURE,
        w(MAG, "4b 01"),
        r(MAG, "5d", "00" * 21),
        *NORMAL,
        w(MAG, "4b 01"),
        w(MAG, "51 04 0e"),
        r(MAG, "51", "04 0e"),
        w(MAG, "4c 00"),
        *field(ACC, "0f", "05", "05"),
        # 0x32: amplitude bit 4, sign bit 2, axis 01, 10, 11; at 4 g 512 counts per g: 800 mg are 410 counts
        *deflected("15", (205, 0, 0)),
        *deflected("11", (-205, 0, 0)),
        *deflected("16", (0, 300, 0)),
        *deflected("12", (0, -300, 0)),
        *deflected("17", (0, 0, 100)),
        *deflected("13", (0, 0, -100)),
        w(ACC, "32 00"),
        *field(ACC, "0f", "05", "05"),
        w(GYR, "3c 01"),
        r(GYR, "3c", "10"),
        r(GYR, "3c", "12"),
        r(GYR, "3c", "12"),
        w(MAG, "4c 07"),
        r(MAG, "4c", "06"),
        r(MAG, "42", "01 00 01 00 00 00 00 00"),
        mag_rate_hz=10,
    )
    imu.configure(rate_hz=100, accel_range_g=4, gyro_range_dps=500)
    report = imu.self_test()
    passed = {axis.axis: axis.passed for axis in report.axes}
    assert passed == {
        "accel_x": True,  # 410 / 512 = 801 mg
        "accel_y": True,
        "accel_z": False,  # 391 mg, 400 wanted
        "gyro": True,
        "field_x": True,
        "field_y": True,
        "field_z": False,
    }
    bus.done()


@pytest.mark.parametrize(
    ("mode", "accel_byte", "gyro_byte"), [(PowerMode.ACCEL_ONLY, "00", "80"), (PowerMode.SLEEP, "80", "80")]
)
def test_power_modes(mode: PowerMode, accel_byte: str, gyro_byte: str):
    imu, bus, _ = make(w(ACC, "11" + accel_byte), w(GYR, "11" + gyro_byte))
    imu.power(mode)
    bus.done()
    with pytest.raises(BenchError, match="power modes"):
        imu.power(PowerMode.LOW_POWER)


def test_magnetometer_at_its_own_pace():
    trim = "00 00 000000 0000 00 00 0000 9001 2060 0040 0000 00 00"
    data = r(MAG, "42", "4006 c0f9 0000 0180")  # x = 200, y = -200, z = 0, RHALL = 0x2000, new
    none = [*heads(0, 0)]
    imu, bus, clock = make(
        *CONFIGURE,
        w(MAG, "4b 01"),
        r(MAG, "5d", trim),
        *NORMAL,
        w(MAG, "4b 01"),
        w(MAG, "51 04 0e"),
        r(MAG, "51", "04 0e"),
        w(MAG, "4c 00"),  # 10 Hz, normal mode
        *STREAM,
        r(ACC, "0e", "01"),
        r(GYR, "0e", "01"),
        *STREAM,
        *[*none, r(MAG, "42", "00" * 8)],  # not ready: asked again next time
        *[*none, data],
        *none,
        mag_rate_hz=10,
    )
    imu.configure(rate_hz=100, accel_range_g=4, gyro_range_dps=500)
    imu.start()
    out = ImuSample()
    imu.read(out)
    assert np.isnan(out.field_T).all()
    clock.burn_ns(10_000_000)
    imu.read(out)
    assert out.field_T[:2] == pytest.approx([62.5e-6, -62.5e-6])
    clock.burn_ns(10_000_000)
    imu.read(out)  # 100 ms have not passed: the die is left alone
    assert out.field_T[0] == pytest.approx(62.5e-6)
    bus.done()
