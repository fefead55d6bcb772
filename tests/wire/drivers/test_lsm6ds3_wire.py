"""LSM6DS3 byte by byte against DocID026899 (registers by name) and AN4650 (self-test)."""

from __future__ import annotations

import math

import numpy as np
import pytest

from drivers.imu.base import ImuBlock, ImuOffsets, ImuSample, PowerMode
from drivers.imu.lsm6ds3 import Lsm6ds3
from hal.clock import VirtualClock
from hal.errors import BenchError, HalTimeout, WrongDevice
from hal.types import Status
from tests.wire.drivers.scripted_ports import ScriptedI2c

MG = 9.80665e-3
MDPS = math.pi / 180e3
Step = tuple[int, object]


def w(data: str) -> Step:
    return (0x6A, [("w", bytes.fromhex(data))])


def r(register: str, answer: str) -> Step:
    return (0x6A, [("w", bytes.fromhex(register)), ("r", bytes.fromhex(answer))])


# CTRL3_C: BDU bit 6, IF_INC bit 2; CTRL4_C: XL_BW_SCAL_ODR bit 7
CONFIGURE = [w("12 44 80"), r("12", "44 80")]
# FIFO_CTRL5 bypass; CTRL6_C/CTRL7_G high performance; CTRL1_XL 104 Hz, 4 g, 50 Hz; CTRL2_G 104 Hz, 2000 deg/s
ON = [w("0a 00"), w("15 00 00"), w("10 4b 4c")]
START = [*ON, r("1e", "00"), r("1e", "07")]
# FIFO_CTRL3: both without decimation; FIFO_CTRL5: ODR_FIFO 104 Hz, continuous
START_FIFO = [*ON, r("1e", "07"), w("08 09"), w("0a 26")]


def make(*script: Step) -> tuple[Lsm6ds3, ScriptedI2c, VirtualClock]:
    clock = VirtualClock()
    bus = ScriptedI2c(script)
    return Lsm6ds3(bus, clock), bus, clock


def running(*script: Step, fifo: bool = False) -> tuple[Lsm6ds3, ScriptedI2c, VirtualClock]:
    imu, bus, clock = make(*CONFIGURE, *(START_FIFO if fifo else START), *script)
    imu.configure(rate_hz=100, accel_range_g=4, gyro_range_dps=2000)
    imu.start("fifo" if fifo else "data ready")
    return imu, bus, clock


def test_identity():
    imu, bus, _ = make(r("0f", "69"))
    assert imu.probe() == "LSM6DS3 at 0x6A"
    bus.done()
    imu, _, _ = make(r("0f", "6a"))  # an LSM6DSL
    with pytest.raises(WrongDevice, match="0x6A"):
        imu.probe()
    with pytest.raises(BenchError, match="SA0"):
        Lsm6ds3(ScriptedI2c([]), VirtualClock(), 0x68)


def test_reset_waits_for_its_bit():
    imu, bus, _ = make(w("12 05"), r("12", "05"), r("12", "04"))  # SW_RESET bit 0, IF_INC stays
    imu.reset()
    bus.done()
    imu, _, clock = make(w("12 05"), *[r("12", "05")] * 4)
    with pytest.raises(HalTimeout, match="reset"):
        imu.reset(limit_s=0.003)
    assert clock.now_ns() == 3_000_000


@pytest.mark.parametrize(
    ("accel_g", "gyro_dps", "rate_hz", "data", "accel_mg", "gyro_mdps", "actual_hz"),
    [
        (2, 125, 12.5, "10 13 12", 0.061, 4.375, 12.5),  # FS_XL 00; FS_125 is bit 1
        (4, 250, 200, "10 5a 50", 0.122, 8.75, 208),  # FS_XL 10; BW_XL 10: 100 Hz
        (8, 500, 416, "10 6d 64", 0.244, 17.5, 416),  # FS_XL 11; 200 Hz
        (16, 1000, 1000, "10 84 88", 0.488, 35.0, 1660),  # FS_XL 01; 400 Hz; next rate above 833 Hz
    ],
)
def test_range_codes_are_not_in_order(
    accel_g: float, gyro_dps: float, rate_hz: float, data: str, accel_mg: float, gyro_mdps: float, actual_hz: float
):
    imu, bus, _ = make(*CONFIGURE, w("0a 00"), w("15 00 00"), w(data), r("1e", "02"))
    setup = imu.configure(rate_hz=rate_hz, accel_range_g=accel_g, gyro_range_dps=gyro_dps)
    imu.start()
    assert setup.rate_hz == actual_hz
    assert setup.accel_lsb_mps2 == pytest.approx(accel_mg * MG)
    assert setup.gyro_lsb_rad_s == pytest.approx(gyro_mdps * MDPS)
    bus.done()


def test_one_burst_is_one_sample():
    # STATUS_REG 0x1E, 0x1F reserved, then little-endian temperature, gyro, accelerometer
    imu, bus, clock = running(r("1e", "07 00 a0ff 0100 feff 0300 0420 fcdf 0000"))
    clock.burn_ns(9_615_385)
    out = ImuSample()
    assert imu.read(out) is Status.OK
    assert out.raw.tolist() == [0x2004, -0x2004, 0, 1, -2, 3, -96]
    assert out.accel_mps2 == pytest.approx(np.array([0x2004, -0x2004, 0]) * 0.122 * MG)
    assert out.gyro_rad_s == pytest.approx(np.array([1, -2, 3]) * 70 * MDPS)
    assert out.temperature_C == pytest.approx(25.0 - 6.0)  # 16 counts per degC
    assert (out.t_ns, out.seq) == (clock.now_ns(), 0)
    bus.done()


@pytest.mark.parametrize("status", ["00", "01", "02", "04"])
def test_half_new_is_not_new(status: str):
    imu, _, _ = running(r("1e", status + "00" * 15))
    out = ImuSample()
    assert imu.read(out) is Status.STALE
    assert (imu.stale, out.seq) == (1, -1)


def test_full_scale_is_saturation():
    imu, _, _ = running(r("1e", "03 00 0000 0000 0000 ff7f 0000 0000 0000"))
    assert imu.read(ImuSample()) is Status.SATURATED


def test_fifo_frames_gyro_first():
    # FIFO_STATUS1/2: 12 words; pattern 0; frames of gyro, accelerometer
    frame = "0100 0200 0300 0400 0500 0600"
    imu, bus, clock = running(r("3a", "0c 00 00 00"), r("3e", frame + "ffff" * 6), r("1e", "00 00 1000"), fifo=True)
    clock.burn_ns(20_000_000)
    out = ImuBlock(8)
    assert imu.read_fifo(out) == 2
    assert out.raw[:2].tolist() == [[4, 5, 6, 1, 2, 3], [-1] * 6]
    assert out.temperature_C == 26.0
    assert out.gyro_rad_s[0] == pytest.approx(np.array([1, 2, 3]) * 70 * MDPS)
    assert (out.dt_ns, out.t0_ns) == (9_615_385, clock.now_ns() - 9_615_385)
    bus.done()


def test_fifo_begun_frame_is_thrown_away_and_overrun_counted():
    # FIFO_STATUS2 bit 6 over run; FIFO_STATUS3: word 4 of 6 comes next, so two words belong to a begun frame
    script = [r("3a", "00 10 00 00"), r("1e", "00 00 0000")]
    script += [r("3a", "08 40 04 00"), r("3e", "0000 0000"), r("3e", "0700" * 6), r("1e", "00 00 0000")]
    imu, bus, clock = running(*script, fifo=True)
    out = ImuBlock()
    assert imu.read_fifo(out) == 0
    clock.burn_ns(96_153_850)  # ten periods
    assert imu.read_fifo(out) == 1
    assert out.raw[0].tolist() == [7] * 6
    assert (out.lost, out.seq0, out.status, imu.lost) == (9, 9, Status.OVERRUN, 9)
    bus.done()


def test_offsets_are_the_drivers_own():
    imu, bus, _ = running(r("1e", "03" + "00" * 15))
    offsets = ImuOffsets((0.1, 0.0, -0.1), (0.01, 0.0, 0.0))
    assert imu.write_offsets(offsets) == imu.read_offsets() == offsets
    out = ImuSample()
    imu.read(out)
    assert out.accel_mps2 == pytest.approx([0.1, 0.0, -0.1])
    assert out.gyro_rad_s == pytest.approx([0.01, 0.0, 0.0])
    assert not out.raw.any()
    bus.done()


def test_self_test_of_the_application_note():
    def sample(gyro: str, accel: str) -> Step:
        return r("1e", "07 00 0000" + gyro * 3 + accel * 3)

    ready = r("1e", "07")

    def five(gyro: str, accel: str) -> list[Step]:
        # the first after a change is thrown away
        return [ready, sample("ff7f", "ff7f"), *[ready, sample(gyro, accel)] * 5]

    imu, bus, clock = running(
        w("10 30 00"),  # 52 Hz, 2 g, gyro off
        *five("0000", "0000"),
        w("14 01"),  # ST_XL positive
        *five("0000", "0010"),  # 4096 counts of 0.061 mg = 249.9 mg
        w("14 00"),
        w("10 00 5c"),  # accelerometer off, 208 Hz, 2000 deg/s
        *five("0000", "0000"),
        w("14 04"),  # ST_G positive
        *five("e803", "0000"),  # 1000 counts of 70 mdps = 70 deg/s: too little
        w("14 00"),
        w("10 00 00"),
        *START,
    )
    report = imu.self_test()
    assert [a.passed for a in report.axes] == [True] * 3 + [False] * 3
    assert report.axes[0].value == pytest.approx(4096 * 0.061)
    assert report.axes[3].value == pytest.approx(70.0)
    assert clock.now_ns() >= 1_260_000_000  # 200, 200, 800 and 60 ms
    bus.done()


@pytest.mark.parametrize(
    ("mode", "data"),
    [
        (PowerMode.NORMAL, ["15 00 00", "10 4b 4c"]),
        (PowerMode.LOW_POWER, ["15 10 80", "10 4b 4c"]),  # XL_HM_MODE, G_HM_MODE
        (PowerMode.ACCEL_ONLY, ["15 00 00", "10 4b 00"]),
        (PowerMode.SLEEP, ["15 00 00", "10 00 00"]),
    ],
)
def test_power_modes(mode: PowerMode, data: list[str]):
    imu, bus, _ = make(*CONFIGURE, *[w(d) for d in data])
    imu.configure(rate_hz=100, accel_range_g=4, gyro_range_dps=2000)
    imu.power(mode)
    bus.done()
