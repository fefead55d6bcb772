"""Drives the BMX055: three dies (accelerometer 12 bit, gyro 16 bit, magnetometer) at three addresses of one I2C bus.

Source: Bosch BST-BMX055-DS000 rev 1.1. Data registers are updated axis after axis, FIFO frames hold one instant
("FIFO operating modes"): so samples always come out of the FIFOs, which also count what was not read. The gyro
sets the pace; the accelerometer has a clock of its own and gives the frame nearest in time.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np

from drivers.base import next_due_ns, wait_s
from drivers.imu import bmx055_map as m
from drivers.imu.base import (
    AXES,
    RAD_PER_DEG,
    STANDARD_GRAVITY,
    AxisTest,
    FifoTimeline,
    ImuBlock,
    ImuOffsets,
    ImuSample,
    ImuSetup,
    Mode,
    PowerMode,
    SelfTestReport,
    imu_channels,
    offset_counts,
    pick_bandwidth,
    pick_range,
    pick_rate,
    require_mode,
)
from drivers.imu.bmx055_addresses import check_addresses
from drivers.imu.bmx055_mag import TRIM_BYTES, MagTrim, counts
from drivers.imu.registers import Register, RegisterFile, join, signed
from hal.arrays import Int32Array
from hal.contracts import Clock, I2cBus
from hal.errors import BenchError, HalTimeout
from hal.types import ChannelInfo, Status, TimeSource

START_UP_S = 0.03  # gyro; the others need 3 ms
OFFSET_STEP_G = 1.0 / 128.0
OFFSET_STEP_DPS = 125.0 / 2048.0
SELF_TEST_LIMITS_MG = (800.0, 800.0, 400.0)  # "Self-test": positive minus negative deflection, at least
FRAME_BYTES = 6
FRAMES_PER_TRANSFER = 42  # 252 bytes
MAG_REPETITIONS = (0x04, 0x0E)  # REPXY, REPZ of the data sheet's "regular" preset: 9 and 15
MAG_RANGE_T = (1300e-6, 1300e-6, 2500e-6, 0.3e-6)  # x, y, z and the step


class Bmx055:
    """Drives one part. ``mag_rate_hz`` = 0 leaves the magnetometer suspended and sends nothing to its address.

    ``overruns`` of either FIFO are counted; ``lost`` and ``stale`` count since ``start``.
    """

    def __init__(
        self,
        bus: I2cBus,
        clock: Clock,
        address: int = 0x18,
        *,
        gyro_address: int = 0x68,
        mag_address: int = 0x10,
        mag_rate_hz: float = 10.0,
        name: str = "imu",
    ) -> None:
        check_addresses(address, gyro_address, mag_address, name)
        if mag_rate_hz and mag_rate_hz not in m.MAG_RATES:
            raise BenchError(f"mag_rate_hz = {mag_rate_hz:g} is not 0 or one of {sorted(m.MAG_RATES)}", device=name)
        self.name = name
        self.setup, self._codes = _setup(100.0, 2.0, 250.0, None, name)
        self.stale = 0
        self.overruns = 0
        self.trim: MagTrim | None = None
        self._clock = clock
        self._accel = RegisterFile(bus, clock, address, f"{name} accelerometer")
        self._gyro = RegisterFile(bus, clock, gyro_address, f"{name} gyro")
        self._mag = RegisterFile(bus, clock, mag_address, f"{name} magnetometer") if mag_rate_hz else None
        self._mag_period_ns = round(1e9 / mag_rate_hz) if mag_rate_hz else 0
        self._mag_control = join((m.MAG_RATE, m.MAG_RATES[mag_rate_hz])) if mag_rate_hz else 0
        self._mag_due_ns = 0
        self._accel_head = self._accel.burst(m.ACC_TEMP, 7)  # temperature .. FIFO_STATUS
        self._gyro_head = self._gyro.burst(m.GYR_FIFO_STATUS, 1)
        self._mag_data = self._mag.burst(m.MAG_DATA, 8) if self._mag else None
        self._timeline = FifoTimeline()
        self._configured = False
        self._mode: Mode | None = None
        self._gyro_on = True
        self._pending = ImuBlock(0)
        self._newest: Int32Array = np.zeros(6, np.int32)
        self._field_T = np.full(3, np.nan)
        self._t_ns = 0
        self._seq = -1

    @property
    def lost(self) -> int:
        return self._timeline.lost

    def probe(self) -> str:
        """Return the identity of all dies. This switches the magnetometer on."""
        self._accel.identify(m.ACC_CHIPID, "BMX055")
        self._gyro.identify(m.GYR_CHIPID, "BMX055")
        where = f"0x{self._accel.address:02X}, 0x{self._gyro.address:02X}"
        if self._mag:
            self._mag.write(m.MAG_POWER, join((m.MAG_ON, 1)))
            wait_s(self._clock, 0.003)
            self._mag.identify(m.MAG_CHIPID, "BMX055")
            where += f", 0x{self._mag.address:02X}"
        return f"BMX055 at {where}"

    def reset(self, limit_s: float = 0.2) -> None:
        """Soft reset of all dies; each answers with its identity again when done."""
        self._mode = None
        self._configured = False
        self._accel.write(m.ACC_SOFTRESET, m.SOFT_RESET)
        self._gyro.write(m.GYR_SOFTRESET, m.SOFT_RESET)
        wait_s(self._clock, START_UP_S)
        self._accel.await_field(m.ACC_ID, m.ACC_CHIPID.reset or 0, limit_s, "reset")
        self._gyro.await_field(m.GYR_ID, m.GYR_CHIPID.reset or 0, limit_s, "reset")
        if self._mag:
            self._mag.write(m.MAG_POWER, m.MAG_RESET | join((m.MAG_ON, 1)))
            wait_s(self._clock, 0.003)
            self._mag.await_field(m.MAG_ID, m.MAG_CHIPID.reset or 0, limit_s, "reset")

    def configure(
        self, *, rate_hz: float, accel_range_g: float, gyro_range_dps: float, bandwidth_hz: float | None = None
    ) -> ImuSetup:
        """See ``Imu.configure``; ``rate_hz`` is the gyro's, the accelerometer's is the next one not below."""
        self.setup, self._codes = _setup(rate_hz, accel_range_g, gyro_range_dps, bandwidth_hz, self.name)
        accel_range, accel_bw, gyro_range, gyro_bw = self._codes
        self._accel.update_checked(m.ACC_RANGE_SEL, accel_range)
        self._accel.update_checked(m.ACC_BW_SEL, accel_bw)
        self._gyro.update_checked(m.GYR_RANGE_SEL, gyro_range)
        self._gyro.update_checked(m.GYR_BW_SEL, gyro_bw)
        if self._mag:
            self._mag.write(m.MAG_POWER, join((m.MAG_ON, 1)))
            wait_s(self._clock, 0.003)
            self.trim = MagTrim.decode(self._mag.read_block(m.MAG_TRIM, TRIM_BYTES))
        self._configured = True
        return self.setup

    def start(self, mode: Mode = "data ready", limit_s: float = 0.5) -> None:
        if not self._configured:
            raise BenchError("start before configure", device=self.name)
        self.power(PowerMode.NORMAL)
        wait_s(self._clock, START_UP_S)
        limit_ns = self._clock.now_ns() + round(limit_s * 1e9)
        self._empty()
        for die, status in ((self._accel, m.ACC_FIFO_STATUS), (self._gyro, m.GYR_FIFO_STATUS)):
            while not die.read(status) & m.FIFO_FRAMES:
                if self._clock.now_ns() >= limit_ns:
                    raise HalTimeout(f"no first sample within {limit_s} s; is the part powered?", device=die.name)
                wait_s(self._clock, 0.001)
        self._empty()
        self._timeline.restart(round(1e9 / self.setup.rate_hz))
        self._pending = ImuBlock(128)
        self.stale = 0
        self.overruns = 0
        self._seq = -1
        self._mag_due_ns = self._clock.now_ns()
        self._mode = mode

    def read(self, out: ImuSample) -> Status:
        """Return the newest frame of both FIFOs. Older frames that were not read in time count as ``lost``."""
        require_mode(self._mode, "data ready", self.name)
        t_ns = self._clock.now_ns()
        block = self._pending
        n = self._drain(block, t_ns)
        self._poll_magnetometer(t_ns)
        status = block.status
        if n:
            raw = block.raw[n - 1]
            out.lost = block.lost + n - 1
            self._timeline.lost += n - 1
            self._t_ns = t_ns
            self._seq = block.seq0 + n - 1
            if out.lost:
                status |= Status.OVERRUN
        else:
            raw = self._newest
            out.lost = block.lost
            self.stale += 1
        out.raw[:6] = raw
        out.raw[6] = round((block.temperature_C - 23.0) * 2.0)
        np.multiply(raw[:3], self.setup.accel_lsb_mps2, out=out.accel_mps2)
        np.multiply(raw[3:], self.setup.gyro_lsb_rad_s if self._gyro_on else np.nan, out=out.gyro_rad_s)
        out.field_T[:] = self._field_T
        out.temperature_C = block.temperature_C
        out.t_ns = self._t_ns
        out.seq = self._seq
        out.source = TimeSource.HOST
        out.status = status
        return status

    def read_fifo(self, out: ImuBlock) -> int:
        require_mode(self._mode, "fifo", self.name)
        n = self._drain(out, self._clock.now_ns())
        self._poll_magnetometer(self._clock.now_ns())
        np.multiply(out.raw[:n, :3], self.setup.accel_lsb_mps2, out=out.accel_mps2[:n])
        gyro_lsb = self.setup.gyro_lsb_rad_s if self._gyro_on else np.nan
        np.multiply(out.raw[:n, 3:], gyro_lsb, out=out.gyro_rad_s[:n])
        return n

    @property
    def field_T(self) -> tuple[float, float, float]:
        """Return the newest field of the magnetometer (3,) in T; NaN before the first reading and without
        magnetometer."""
        x, y, z = self._field_T
        return float(x), float(y), float(z)

    def read_offsets(self) -> ImuOffsets:
        accel = [signed(b, 8) * OFFSET_STEP_G * STANDARD_GRAVITY for b in self._accel.read_block(m.ACC_OFFSET_X, 3)]
        o1, x, y, z = self._gyro.read_block(m.GYR_OFC1, 4)
        low = self._gyro.read(m.GYR_TRIM_GP0)
        words = (
            x << 4 | (o1 >> 6 & 0b11) << 2 | low >> 2 & 0b11,
            y << 4 | (o1 >> 3 & 0b111) << 1 | low >> 1 & 1,
            z << 4 | (o1 & 0b111) << 1 | low & 1,
        )
        gyro = [signed(word, 12) * OFFSET_STEP_DPS * RAD_PER_DEG for word in words]
        return ImuOffsets((accel[0], accel[1], accel[2]), (gyro[0], gyro[1], gyro[2]))

    def write_offsets(self, offsets: ImuOffsets) -> ImuOffsets:
        """8 bit of 7.8 mg (ACC 0x38) and 12 bit of 0.061 deg/s, scattered over five registers (GYR 0x36)."""
        accel = offset_counts(
            offsets.accel_mps2, OFFSET_STEP_G * STANDARD_GRAVITY, -128, 127, "accelerometer", self.name
        )
        gyro = offset_counts(offsets.gyro_rad_s, OFFSET_STEP_DPS * RAD_PER_DEG, -2048, 2047, "gyro", self.name)
        self._accel.write_checked(m.ACC_OFFSET_X, *(c & 0xFF for c in accel))
        x, y, z = (c & 0xFFF for c in gyro)
        o1 = (x >> 2 & 0b11) << 6 | (y >> 1 & 0b111) << 3 | z >> 1 & 0b111
        self._gyro.write_checked(m.GYR_OFC1, o1, x >> 4, y >> 4, z >> 4)
        self._gyro.update_checked(m.GYR_OFFSET_LOW, (x & 0b11) << 2 | (y & 1) << 1 | z & 1)
        return self.read_offsets()

    def self_test(self, limit_s: float = 3.0) -> SelfTestReport:
        """Accelerometer deflected both ways at 4 g, gyro's built-in test, magnetometer's normal self-test."""
        mode = self._mode
        if not self._configured:
            raise BenchError("self-test before configure", device=self.name)
        self.power(PowerMode.NORMAL)
        wait_s(self._clock, START_UP_S)
        tests: list[AxisTest] = []
        try:
            self._accel.update_checked(m.ACC_RANGE_SEL, m.ACCEL_CODES[4.0])
            for i, axis in enumerate(AXES):
                both: list[int] = []
                for sign in (1, 0):
                    test = join((m.ACC_ST_AMP, 1), (m.ACC_ST_SIGN, sign), (m.ACC_ST_AXIS, i + 1))
                    self._accel.write(m.ACC_SELF_TEST, test)
                    wait_s(self._clock, 0.05)
                    both.append(struct.unpack("<3h", self._accel.read_block(m.ACC_DATA, FRAME_BYTES))[i] >> 4)
                change_mg = (both[0] - both[1]) / 512.0 * 1000.0
                tests.append(AxisTest(f"accel_{axis}", change_mg, SELF_TEST_LIMITS_MG[i], np.inf, "mg"))
        finally:
            self._accel.write(m.ACC_SELF_TEST, 0)
            self._accel.update_checked(m.ACC_RANGE_SEL, self._codes[0])
        self._gyro.write(m.GYR_BIST, join((m.BIST_TRIGGER, 1)))
        self._gyro.await_field(m.BIST_READY, 1, limit_s, "built-in test")
        bist = self._gyro.read(m.GYR_BIST)
        bad = m.BIST_FAIL.take(bist) + (1 - m.BIST_RATE_OK.take(bist))
        tests.append(AxisTest("gyro", float(bad), 0.0, 0.0, "failed checks"))
        if self._mag:
            self._mag.write(m.MAG_CONTROL, join((m.MAG_MODE, m.MAG_SLEEP), (m.MAG_ST, 1)))
            self._mag.await_field(m.MAG_ST, 0, limit_s, "magnetometer self-test")
            data = self._mag.read_block(m.MAG_DATA, 8)
            tests += [AxisTest(f"field_{a}", float(data[2 * i] & 1), 1.0, 1.0, "passed") for i, a in enumerate(AXES)]
        if mode is not None:
            self.start(mode)
        return SelfTestReport(tuple(tests), "BST-BMX055-DS000, Self-test of accelerometer, gyroscope, magnetometer")

    def power(self, mode: PowerMode) -> None:
        """``ACCEL_ONLY`` suspends the gyro (its rates are NaN), ``SLEEP`` all dies. ``start`` wakes up."""
        if mode is PowerMode.LOW_POWER:
            raise BenchError("power modes of a BMX055 are normal, accelerometer only and sleep", device=self.name)
        asleep = mode is PowerMode.SLEEP
        self._gyro_on = mode is PowerMode.NORMAL
        self._accel.write(m.ACC_LPW, join((m.ACC_SUSPEND, int(asleep))))
        self._gyro.write(m.GYR_LPM1, join((m.GYR_SUSPEND, int(not self._gyro_on))))
        if self._mag:
            self._mag.write(m.MAG_POWER, join((m.MAG_ON, int(not asleep))))
            if not asleep:
                # leaving suspend is a power-on reset of this die
                wait_s(self._clock, 0.003)
                self._mag.write_checked(m.MAG_REPXY, *MAG_REPETITIONS)
                self._mag.write(m.MAG_CONTROL, self._mag_control)
        if asleep:
            self._mode = None

    def channels(self) -> Sequence[ChannelInfo]:
        return imu_channels(self.name, self.setup, (-41.0, 86.5, 0.5), MAG_RANGE_T if self._mag else ())

    def _empty(self) -> None:
        """Empty both FIFOs and clear their overrun flags: writing FIFO_CONFIG_1 does that."""
        self._accel.write(m.ACC_FIFO_CONFIG_1, join((m.ACC_FIFO_MODE, m.STREAM)))
        self._gyro.write(m.GYR_FIFO_CONFIG_1, join((m.GYR_FIFO_MODE, m.STREAM)))

    def _drain(self, out: ImuBlock, arrival_ns: int) -> int:
        """Write all frames of both FIFOs into ``out.raw``, one row per frame of the leading die, and fill its head."""
        head = self._accel_head()
        out.temperature_C = signed(head[0], 8) * 0.5 + 23.0
        accel_status, gyro_status = head[6], self._gyro_head()[0] if self._gyro_on else 0
        n_accel, n_gyro = accel_status & m.FIFO_FRAMES, gyro_status & m.FIFO_FRAMES
        waiting = n_gyro if self._gyro_on else n_accel
        n = min(waiting, out.capacity)
        overrun = bool((accel_status | gyro_status) & m.FIFO_OVERRUN)
        if n:
            accel = self._frames(self._accel, m.ACC_FIFO_DATA, n_accel) >> 4
            rows = out.raw[:n]
            if len(accel):
                rows[:, :3] = accel[(2 * np.arange(n) + 1) * len(accel) // (2 * n)]
            else:
                rows[:, :3] = self._newest[:3]
            if self._gyro_on:
                rows[:, 3:] = self._frames(self._gyro, m.GYR_FIFO_DATA, n)
            self._newest[:] = rows[-1]
        if overrun:
            self.overruns += 1
            self._empty()
        self._timeline.stamp(out, n, arrival_ns, overrun, left=0 if overrun else waiting - n)
        if n and self._saturated(out.raw[:n]):
            out.status |= Status.SATURATED
        return n

    def _frames(self, die: RegisterFile, data: Register, n: int) -> Int32Array:
        parts: list[bytes] = []
        while n > 0:
            now = min(n, FRAMES_PER_TRANSFER)
            parts.append(die.read_block(data, now * FRAME_BYTES))
            n -= now
        return np.frombuffer(b"".join(parts), "<i2").reshape(-1, 3).astype(np.int32)

    @staticmethod
    def _saturated(raw: Int32Array) -> bool:
        return bool(
            raw[:, :3].max() >= 2047
            or raw[:, :3].min() <= -2048
            or raw[:, 3:].max() >= 32767
            or raw[:, 3:].min() <= -32767
        )

    def _poll_magnetometer(self, t_ns: int) -> None:
        if self._mag_data is None or self.trim is None or t_ns < self._mag_due_ns:
            return
        new, x, y, z, rhall = counts(self._mag_data())
        if new:
            self._field_T[:] = self.trim.field_T(x, y, z, rhall)
            self._mag_due_ns = next_due_ns(self._mag_due_ns, t_ns, self._mag_period_ns)


def _setup(
    rate_hz: float, accel_range_g: float, gyro_range_dps: float, bandwidth_hz: float | None, name: str
) -> tuple[ImuSetup, tuple[int, int, int, int]]:
    """Return the settings that the chip will use and the register codes for them.

    The codes are those of accelerometer range and bandwidth and of gyro range and bandwidth, in this order."""
    accel_range = pick_range(accel_range_g, m.ACCEL_CODES, "accel_range_g", name)
    gyro_range = pick_range(gyro_range_dps, m.GYRO_CODES, "gyro_range_dps", name)
    gyro_hz, _ = pick_rate(rate_hz, dict.fromkeys(m.GYRO_FILTERS, 0), name)
    accel_hz, accel_bw = pick_rate(gyro_hz, m.ACCEL_RATES, name)
    gyro_bandwidth_hz, gyro_bw = pick_bandwidth(
        gyro_hz / 2 if bandwidth_hz is None else bandwidth_hz, m.GYRO_FILTERS[gyro_hz]
    )
    setup = ImuSetup(
        rate_hz=gyro_hz,
        accel_range_g=accel_range_g,
        gyro_range_dps=gyro_range_dps,
        accel_lsb_mps2=STANDARD_GRAVITY * accel_range_g / 2048.0,
        gyro_lsb_rad_s=RAD_PER_DEG / m.GYRO_LSB_PER_DPS[gyro_range_dps],
        accel_bandwidth_hz=accel_hz / 2,
        gyro_bandwidth_hz=gyro_bandwidth_hz,
    )
    return setup, (accel_range, accel_bw, gyro_range, gyro_bw)
