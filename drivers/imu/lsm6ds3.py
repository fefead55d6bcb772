"""Drives an LSM6DS3: six axes over I2C, 16 bit, both sensors off after power-up.

Source: STMicroelectronics DocID026899 (registers, limits) and AN4650 (self-test procedure). Block data update
keeps the bytes of one sample together (CTRL3_C), and the burst begins with STATUS_REG, so one burst is one
instant and says whether it is new. The part has no offset registers (its successors have): offsets are added
here, on top of what the chip gives, and are gone with this object.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np

from drivers.base import wait_s
from drivers.imu import lsm6ds3_map as m
from drivers.imu.base import (
    AXES,
    RAD_PER_DEG,
    STANDARD_GRAVITY,
    AxisTest,
    CountingImu,
    ImuBlock,
    ImuOffsets,
    ImuSample,
    ImuSetup,
    Mode,
    PowerMode,
    SelfTestReport,
    imu_channels,
    pick_bandwidth,
    pick_range,
    pick_rate,
    require_mode,
)
from drivers.imu.registers import Field, RegisterFile, join
from hal.contracts import Clock, I2cBus
from hal.errors import BenchError
from hal.types import ChannelInfo, Status

ADDRESSES = (0x6A, 0x6B)  # SA0 low, high
STATUS_TO_DATA = 2  # STATUS_REG, one reserved byte, then temperature
FRAME = struct.Struct("<7h")  # temperature, gyro, accelerometer
FIFO_FRAME = struct.Struct("<6h")  # gyro, accelerometer (AN4650, FIFO pattern)
FIFO_WORDS = 6
FRAMES_PER_TRANSFER = 21  # 252 bytes
ACCEL_LIMITS_MG = (90.0, 1700.0)  # "Mechanical characteristics", LA_ST
GYRO_LIMITS_DPS = (150.0, 700.0)  # G_ST at 2000 deg/s
SELF_TEST_SAMPLES = 5


class Lsm6ds3(CountingImu):
    """Drives one chip. ``setup`` holds its settings; ``lost`` and ``stale`` count since ``start``."""

    def __init__(self, bus: I2cBus, clock: Clock, address: int = 0x6A, *, name: str = "imu") -> None:
        if address not in ADDRESSES:
            raise BenchError(f"address 0x{address:02X} is not 0x6A (SA0 low) or 0x6B (SA0 high)", device=name)
        self.name = name
        self.setup, self._settings = _setup(104.0, 2.0, 250.0, None, name)
        self._clock = clock
        self._chip = RegisterFile(bus, clock, address, name)
        self._burst = self._chip.burst(m.STATUS_REG, STATUS_TO_DATA + FRAME.size)
        super().__init__()
        self._configured = False
        self._gyro_on = True
        self._offsets = ImuOffsets()
        self._accel_offset = np.zeros(3)
        self._gyro_offset = np.zeros(3)

    def probe(self) -> str:
        self._chip.identify(m.WHO_AM_I, "LSM6DS3")
        return f"LSM6DS3 at 0x{self._chip.address:02X}"

    def reset(self, limit_s: float = 0.1) -> None:
        """Reset by software; the bit clears when done (50 us typical). Offsets are set to zero."""
        self._mode = None
        self._configured = False
        self._chip.write(m.CTRL3_C, join((m.IF_INC, 1), (m.SW_RESET, 1)))
        self._chip.await_field(m.SW_RESET, 0, limit_s, "reset")
        self.write_offsets(ImuOffsets())

    def configure(
        self, *, rate_hz: float, accel_range_g: float, gyro_range_dps: float, bandwidth_hz: float | None = None
    ) -> ImuSetup:
        """See ``Imu.configure``. Both sensors run at one rate; ``bandwidth_hz`` sets the accelerometer's
        anti-aliasing filter, the gyro's follows the rate (stated as half of it, the nominal figure)."""
        self.setup, self._settings = _setup(rate_hz, accel_range_g, gyro_range_dps, bandwidth_hz, self.name)
        self._chip.write_checked(m.CTRL3_C, join((m.BDU, 1), (m.IF_INC, 1)), join((m.XL_BW_SCAL_ODR, 1)))
        self._configured = True
        return self.setup

    def start(self, mode: Mode = "data ready", limit_s: float = 1.0) -> None:
        if not self._configured:
            raise BenchError("start before configure", device=self.name)
        fifo = mode == "fifo"
        chip = self._chip
        chip.write(m.FIFO_CTRL5, join((m.FIFO_MODE, m.BYPASS)))  # also empties it
        self.power(PowerMode.NORMAL)
        chip.await_field(m.GDA, 1, limit_s, "first sample")
        period_ns = round(1e9 / self.setup.rate_hz)
        self._counter.restart(period_ns)
        self._timeline.restart(period_ns)
        if fifo:
            chip.write(m.FIFO_CTRL3, join((m.DEC_FIFO_GYRO, 1), (m.DEC_FIFO_XL, 1)))
            rate = m.RATES[self.setup.rate_hz]
            chip.write(m.FIFO_CTRL5, join((m.ODR_FIFO, rate), (m.FIFO_MODE, m.CONTINUOUS)))
        self._mode = mode

    def read(self, out: ImuSample) -> Status:
        """Read gyro and accelerometer as a pair. The sample is new only when both sensors have new values."""
        require_mode(self._mode, "data ready", self.name)
        t_ns = self._clock.now_ns()
        data = self._burst()
        temperature, gx, gy, gz, ax, ay, az = FRAME.unpack_from(data, STATUS_TO_DATA)
        needed = m.GDA.mask | m.XLDA.mask if self._gyro_on else m.XLDA.mask
        status = self._counter.count(out, data[0] & needed == needed, t_ns)
        raw = (ax, ay, az, gx, gy, gz)
        if max(raw) >= 32767 or min(raw) <= -32767:
            status |= Status.SATURATED
        out.raw[:6] = raw
        out.raw[6] = temperature
        k = self.setup.accel_lsb_mps2
        out.accel_mps2[:] = (ax * k, ay * k, az * k)
        out.accel_mps2 += self._accel_offset
        if self._gyro_on:
            k = self.setup.gyro_lsb_rad_s
            out.gyro_rad_s[:] = (gx * k, gy * k, gz * k)
            out.gyro_rad_s += self._gyro_offset
        else:
            out.gyro_rad_s[:] = np.nan
        out.temperature_C = celsius(temperature)
        out.status = status
        return status

    def read_fifo(self, out: ImuBlock) -> int:
        """Read all frames of the FIFO. FIFO_STATUS3/4 state which word of the pattern comes next; an incomplete frame
        is discarded first."""
        require_mode(self._mode, "fifo", self.name)
        arrival_ns = self._clock.now_ns()
        s1, s2, s3, s4 = self._chip.read_block(m.FIFO_STATUS1, 4)
        overrun = bool(s2 & 0x40)
        words = (s2 & 0x0F) << 8 | s1
        ahead = ((s4 & 0x03) << 8 | s3) % FIFO_WORDS
        if ahead and words >= FIFO_WORDS - ahead:
            self._chip.read_block(m.FIFO_DATA_OUT_L, 2 * (FIFO_WORDS - ahead))
            words -= FIFO_WORDS - ahead
            overrun = True
        n = min(words // FIFO_WORDS, out.capacity)
        done = 0
        while done < n:
            frames = min(n - done, FRAMES_PER_TRANSFER)
            data = self._chip.read_block(m.FIFO_DATA_OUT_L, frames * FIFO_FRAME.size)
            for gx, gy, gz, ax, ay, az in FIFO_FRAME.iter_unpack(data):
                out.raw[done] = (ax, ay, az, gx, gy, gz)
                done += 1
        temperature = self._chip.read_block(m.STATUS_REG, STATUS_TO_DATA + 2)
        out.temperature_C = celsius(struct.unpack_from("<h", temperature, STATUS_TO_DATA)[0])
        self._timeline.stamp(out, n, arrival_ns, overrun, left=words // FIFO_WORDS - n)
        raw = out.raw[:n]
        out.accel_mps2[:n] = raw[:, :3] * self.setup.accel_lsb_mps2 + self._accel_offset
        out.gyro_rad_s[:n] = raw[:, 3:] * self.setup.gyro_lsb_rad_s + self._gyro_offset
        if n and (raw.max() >= 32767 or raw.min() <= -32767):
            out.status |= Status.SATURATED
        return n

    def read_offsets(self) -> ImuOffsets:
        return self._offsets

    def write_offsets(self, offsets: ImuOffsets) -> ImuOffsets:
        """Keep the offsets in this object, exactly as given, because the chip has no registers for them."""
        self._offsets = offsets
        self._accel_offset[:] = offsets.accel_mps2
        self._gyro_offset[:] = offsets.gyro_rad_s
        return offsets

    def self_test(self, limit_s: float = 3.0) -> SelfTestReport:
        """Run the self-test of AN4650: accelerometer at 2 g and 52 Hz, gyro at 2000 deg/s and 208 Hz, positive
        direction."""
        mode = self._mode
        if not self._configured:
            raise BenchError("self-test before configure", device=self.name)
        chip = self._chip
        accel_on = join((m.ODR_XL, m.RATES[52.0]), (m.FS_XL, m.ACCEL_CODES[2.0]))
        gyro_on = join((m.ODR_G, m.RATES[208.0]), (m.FS_G, m.GYRO_CODES[2000.0]))
        try:
            chip.write(m.CTRL1_XL, accel_on, 0)
            wait_s(self._clock, 0.2)
            still = self._mean(m.XLDA, limit_s)[3:]
            chip.write(m.CTRL5_C, join((m.ST_XL, 0b01)))
            wait_s(self._clock, 0.2)
            forced = self._mean(m.XLDA, limit_s)[3:]
            accel = [abs(b - a) * m.ACCEL_MG_PER_LSB[2.0] for a, b in zip(still, forced, strict=True)]
            chip.write(m.CTRL5_C, 0)
            chip.write(m.CTRL1_XL, 0, gyro_on)
            wait_s(self._clock, 0.8)
            still = self._mean(m.GDA, limit_s)[:3]
            chip.write(m.CTRL5_C, join((m.ST_G, 0b01)))
            wait_s(self._clock, 0.06)
            forced = self._mean(m.GDA, limit_s)[:3]
            gyro = [abs(b - a) * m.GYRO_MDPS_PER_LSB[2000.0] / 1000.0 for a, b in zip(still, forced, strict=True)]
        finally:
            chip.write(m.CTRL5_C, 0)
            chip.write(m.CTRL1_XL, 0, 0)
        tests = [AxisTest(f"accel_{a}", v, *ACCEL_LIMITS_MG, "mg") for a, v in zip(AXES, accel, strict=True)]
        tests += [AxisTest(f"gyro_{a}", v, *GYRO_LIMITS_DPS, "deg/s") for a, v in zip(AXES, gyro, strict=True)]
        if mode is not None:
            self.start(mode)
        return SelfTestReport(tuple(tests), "DocID026899, mechanical characteristics LA_ST, G_ST; AN4650, self-test")

    def power(self, mode: PowerMode) -> None:
        """Set the power mode. ``LOW_POWER`` leaves the high-performance mode, for up to 208 Hz; ``SLEEP`` switches off.

        Without gyro its rates are NaN. ``start`` wakes up."""
        accel, gyro = self._settings
        low = int(mode is PowerMode.LOW_POWER)
        self._gyro_on = mode in (PowerMode.NORMAL, PowerMode.LOW_POWER)
        self._chip.write(m.CTRL6_C, join((m.XL_HM_MODE, low)), join((m.G_HM_MODE, low)))
        self._chip.write(m.CTRL1_XL, 0 if mode is PowerMode.SLEEP else accel, gyro if self._gyro_on else 0)
        self._counter.restart(round(1e9 / self.setup.rate_hz))
        if mode is PowerMode.SLEEP:
            self._mode = None

    def channels(self) -> Sequence[ChannelInfo]:
        return imu_channels(self.name, self.setup, (-40.0, 85.0, 1.0 / 16.0))

    def _mean(self, fresh: Field, limit_s: float) -> list[float]:
        """Return the mean counts (gyro, accelerometer) of five samples after one that is discarded."""
        sums = [0] * 6
        for i in range(SELF_TEST_SAMPLES + 1):
            self._chip.await_field(fresh, 1, limit_s, "a sample of the self-test")
            _, *values = FRAME.unpack_from(self._burst(), STATUS_TO_DATA)
            if i:
                sums = [s + v for s, v in zip(sums, values, strict=True)]
        return [s / SELF_TEST_SAMPLES for s in sums]


def celsius(raw: int) -> float:
    """Return degC ("Temperature sensor characteristics": 16 counts per degC, 25 degC at zero)."""
    return raw / 16.0 + 25.0


def _setup(
    rate_hz: float, accel_range_g: float, gyro_range_dps: float, bandwidth_hz: float | None, name: str
) -> tuple[ImuSetup, tuple[int, int]]:
    """Return the settings that the chip will use and the values of ``CTRL1_XL`` and ``CTRL2_G`` for them."""
    accel = pick_range(accel_range_g, m.ACCEL_CODES, "accel_range_g", name)
    gyro = pick_range(gyro_range_dps, m.GYRO_CODES, "gyro_range_dps", name)
    actual_hz, rate = pick_rate(rate_hz, m.RATES, name)
    wish_hz = actual_hz / 2 if bandwidth_hz is None else bandwidth_hz
    accel_bandwidth_hz, bandwidth = pick_bandwidth(wish_hz, m.ACCEL_BANDWIDTHS)
    setup = ImuSetup(
        rate_hz=actual_hz,
        accel_range_g=accel_range_g,
        gyro_range_dps=gyro_range_dps,
        accel_lsb_mps2=m.ACCEL_MG_PER_LSB[accel_range_g] * 1e-3 * STANDARD_GRAVITY,
        gyro_lsb_rad_s=m.GYRO_MDPS_PER_LSB[gyro_range_dps] * 1e-3 * RAD_PER_DEG,
        accel_bandwidth_hz=accel_bandwidth_hz,
        gyro_bandwidth_hz=actual_hz / 2,
    )
    ctrl1 = join((m.ODR_XL, rate), (m.FS_XL, accel), (m.BW_XL, bandwidth))
    ctrl2 = join((m.ODR_G, rate), (m.FS_G, gyro), (m.FS_125, int(gyro_range_dps == 125.0)))
    return setup, (ctrl1, ctrl2)
