"""Drives an MPU-6050: six axes over I2C, 16 bit, asleep after power-up.

Source: InvenSense RM-MPU-6000A-00 rev 4.2 (registers) and PS-MPU-6000A-00 rev 3.4 (times, self-test limits).
The sensor registers are handed over to the bus side only while the bus is idle (4.17), so one burst is one
instant. ``INT_STATUS`` stands right before them and is read in the same burst: it says whether they are new.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

from drivers.base import wait_s
from drivers.imu import mpu6050_map as m
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
    offset_counts,
    pick_bandwidth,
    pick_range,
    require_mode,
)
from drivers.imu.registers import RegisterFile, join
from hal.contracts import Clock, I2cBus
from hal.errors import BenchError, HalTimeout
from hal.types import ChannelInfo, Status

ADDRESSES = (0x68, 0x69)  # AD0 low, high
GYRO_START_UP_S = 0.03  # PS 6.1: sleep to ready, typical
BASE_RATE_HZ = 1000.0  # RM 4.2: gyro output rate with the low-pass filter on
FRAME = struct.Struct(">7h")  # accelerometer, temperature, gyro: in the registers and in the FIFO
FIFO_BYTES = 1024
FRAMES_PER_TRANSFER = 18  # 252 bytes
CYCLE_RATE_HZ = 40.0
OFFSET_LSB_PER_G = 2048  # +-16 g at every full scale: mpu6050_map says where from
GYRO_OFFSET_LSB_PER_DPS = 32.8
TRIM_LIMIT = 14.0  # PS 6.1, 6.2: +-14 % of the factory trim
SELF_TEST_SAMPLES = 20


class Mpu6050(CountingImu):
    """Drives one chip. ``setup`` holds its settings; ``lost`` and ``stale`` count since ``start``."""

    def __init__(self, bus: I2cBus, clock: Clock, address: int = 0x68, *, name: str = "imu") -> None:
        if address not in ADDRESSES:
            raise BenchError(f"address 0x{address:02X} is not 0x68 (AD0 low) or 0x69 (AD0 high)", device=name)
        self.name = name
        self.setup, self._settings = _setup(1000.0, 2.0, 250.0, None, name)
        self._clock = clock
        self._chip = RegisterFile(bus, clock, address, name)
        self._burst = self._chip.burst(m.INT_STATUS, 1 + FRAME.size)
        super().__init__()
        self._configured = False
        self._gyro_on = True
        self._temperature_on = True
        self._factory: tuple[int, int, int] | None = None

    def probe(self) -> str:
        self._chip.identify(m.WHO_AM_I, "MPU-6050")
        return f"MPU-6050 at 0x{self._chip.address:02X}"

    def reset(self, limit_s: float = 0.1) -> None:
        """Reset the device (4.28), which clears its bit when done. Read and keep the factory's accelerometer trim."""
        self._mode = None
        self._configured = False
        self._chip.write(m.PWR_MGMT_1, join((m.DEVICE_RESET, 1)))
        self._chip.await_field(m.DEVICE_RESET, 0, limit_s, "reset")
        self._factory = self._accel_words()

    def configure(
        self, *, rate_hz: float, accel_range_g: float, gyro_range_dps: float, bandwidth_hz: float | None = None
    ) -> ImuSetup:
        """See ``Imu.configure``. Rates are 1 kHz / (1 + n), 3.9 Hz at least; the bandwidth is the gyro's."""
        self.setup, self._settings = _setup(rate_hz, accel_range_g, gyro_range_dps, bandwidth_hz, self.name)
        self._chip.write_checked(m.SMPLRT_DIV, *self._settings)
        self._configured = True
        return self.setup

    def start(self, mode: Mode = "data ready", limit_s: float = 0.5) -> None:
        if not self._configured:
            raise BenchError("start before configure", device=self.name)
        chip = self._chip
        self.power(PowerMode.NORMAL)
        wait_s(self._clock, GYRO_START_UP_S)
        fifo = mode == "fifo"
        chip.write(m.INT_ENABLE, join((m.DATA_RDY_EN, 1), (m.FIFO_OFLOW_EN, int(fifo))))
        chip.await_field(m.DATA_RDY_INT, 1, limit_s, "first sample")
        period_ns = round(1e9 / self.setup.rate_hz)
        self._counter.restart(period_ns)
        self._timeline.restart(period_ns)
        chip.write(m.FIFO_EN, join((m.FIFO_SENSORS, 0b11111 if fifo else 0)))
        self._empty_fifo(on=fifo)
        self._mode = mode

    def read(self, out: ImuSample) -> Status:
        require_mode(self._mode, "data ready", self.name)
        t_ns = self._clock.now_ns()
        data = self._burst()
        ax, ay, az, temperature, gx, gy, gz = FRAME.unpack_from(data, 1)
        status = self._counter.count(out, bool(data[0] & m.DATA_RDY_INT.mask), t_ns)
        raw = (ax, ay, az, gx, gy, gz)
        if max(raw) == 32767 or min(raw) == -32768:
            status |= Status.SATURATED
        out.raw[:6] = raw
        out.raw[6] = temperature
        setup = self.setup
        k = setup.accel_lsb_mps2
        out.accel_mps2[:] = (ax * k, ay * k, az * k)
        k = setup.gyro_lsb_rad_s if self._gyro_on else math.nan
        out.gyro_rad_s[:] = (gx * k, gy * k, gz * k)
        out.temperature_C = celsius(temperature) if self._temperature_on else math.nan
        out.status = status
        return status

    def read_fifo(self, out: ImuBlock) -> int:
        """Read all frames of the FIFO. After an overflow the frames are misaligned: the FIFO is emptied, and ``out``
        holds no sample and the number of lost ones."""
        require_mode(self._mode, "fifo", self.name)
        arrival_ns = self._clock.now_ns()
        overflow = self._chip.read(m.INT_STATUS) & m.FIFO_OFLOW_INT.mask
        count = int.from_bytes(self._chip.read_block(m.FIFO_COUNTH, 2), "big")
        if overflow or count >= FIFO_BYTES:
            self._empty_fifo(on=True)
            self._timeline.stamp(out, 0, arrival_ns, overrun=True)
            return 0
        waiting = count // FRAME.size
        n = min(waiting, out.capacity)
        done = 0
        while done < n:
            frames = min(n - done, FRAMES_PER_TRANSFER)
            data = self._chip.read_block(m.FIFO_R_W, frames * FRAME.size)
            for ax, ay, az, temperature, gx, gy, gz in FRAME.iter_unpack(data):
                out.raw[done] = (ax, ay, az, gx, gy, gz)
                out.temperature_C = celsius(temperature)
                done += 1
        self._timeline.stamp(out, n, arrival_ns, overrun=False, left=waiting - n)
        raw = out.raw[:n]
        out.accel_mps2[:n] = raw[:, :3] * self.setup.accel_lsb_mps2
        out.gyro_rad_s[:n] = raw[:, 3:] * self.setup.gyro_lsb_rad_s
        if n and (raw.max() == 32767 or raw.min() == -32768):
            out.status |= Status.SATURATED
        return n

    def read_offsets(self) -> ImuOffsets:
        """Return the gyro's offset registers, and the difference of the accelerometer's to the factory's trim."""
        factory = self._trim()
        accel = [
            (w - f) / OFFSET_LSB_PER_G * STANDARD_GRAVITY for w, f in zip(self._accel_words(), factory, strict=True)
        ]
        words = struct.unpack(">3h", self._chip.read_block(m.XG_OFFS_USRH, 6))
        gyro = [w / GYRO_OFFSET_LSB_PER_DPS * RAD_PER_DEG for w in words]
        return ImuOffsets((accel[0], accel[1], accel[2]), (gyro[0], gyro[1], gyro[2]))

    def write_offsets(self, offsets: ImuOffsets) -> ImuOffsets:
        """Write the offsets. Those of the accelerometer are added to the factory's trim in steps of 2 counts, because
        bit 0 of each word belongs to the temperature compensation. Needs ``reset`` before."""
        factory = self._trim()
        step = 2.0 * STANDARD_GRAVITY / OFFSET_LSB_PER_G
        steps = offset_counts(offsets.accel_mps2, step, -16384, 16383, "accelerometer", self.name)
        words = [f + 2 * s for f, s in zip(factory, steps, strict=True)]
        for axis, word in zip(AXES, words, strict=True):
            if not -32768 <= word <= 32767:
                raise BenchError(f"accelerometer offset of {axis} and factory trim exceed 16 bit", device=self.name)
        step = RAD_PER_DEG / GYRO_OFFSET_LSB_PER_DPS
        gyro = offset_counts(offsets.gyro_rad_s, step, -32768, 32767, "gyro", self.name)
        self._chip.write_checked(m.XA_OFFS_H, *struct.pack(">3h", *words))
        self._chip.write_checked(m.XG_OFFS_USRH, *struct.pack(">3h", *gyro))
        return self.read_offsets()

    def self_test(self, limit_s: float = 3.0) -> SelfTestReport:
        """Compare the reaction to the built-in force with the factory's record of it (RM 4.1), at 8 g and 250 deg/s."""
        mode = self._mode
        if not self._configured:
            raise BenchError("self-test before configure", device=self.name)
        limit_ns = self._clock.now_ns() + round(limit_s * 1e9)
        self.power(PowerMode.NORMAL)
        wait_s(self._clock, GYRO_START_UP_S)
        dlpf = join((m.DLPF_CFG, 2))
        settings = (0, dlpf, join((m.FS_SEL, 0)), join((m.AFS_SEL, m.ACCEL_CODES[8.0])))
        all_axes = (0, dlpf, settings[2] | join((m.GYRO_SELF_TEST, 7)), settings[3] | join((m.ACCEL_SELF_TEST, 7)))
        try:
            self._chip.write_checked(m.SMPLRT_DIV, *settings)
            still = self._mean(limit_ns)
            self._chip.write_checked(m.SMPLRT_DIV, *all_axes)
            forced = self._mean(limit_ns)
            trim = factory_trim(self._chip.read_block(m.SELF_TEST_X, 4))
        finally:
            self._chip.write_checked(m.SMPLRT_DIV, *self._settings)
        names = [f"{kind}_{axis}" for kind in ("accel", "gyro") for axis in AXES]
        tests: list[AxisTest] = []
        for axis, before, after, due in zip(names, still, forced, trim, strict=True):
            change = 100.0 * (after - before - due) / due if due else math.nan
            tests.append(AxisTest(axis, change, -TRIM_LIMIT, TRIM_LIMIT, "% of the factory trim"))
        if mode is None:
            self.power(PowerMode.SLEEP)
        else:
            self.start(mode)
        return SelfTestReport(tuple(tests), "RM-MPU-6000A 4.1; PS-MPU-6000A 6.1, 6.2")

    def power(self, mode: PowerMode) -> None:
        """Set the power mode. ``LOW_POWER`` runs the accelerometer only, at 40 Hz (4.29); rates are NaN then. ``start``
        wakes up."""
        gyro = mode is PowerMode.NORMAL or mode is PowerMode.SLEEP
        cycle = mode is PowerMode.LOW_POWER
        self._chip.write(
            m.PWR_MGMT_1,
            join(
                (m.SLEEP, int(mode is PowerMode.SLEEP)),
                (m.CYCLE, int(cycle)),
                (m.TEMP_DIS, int(cycle)),
                (m.CLKSEL, int(gyro)),  # 4.28: the gyro's clock is the better one, but it must run
            ),
            join((m.LP_WAKE_CTRL, 3 if cycle else 0), (m.GYRO_STANDBY, 0 if gyro else 0b111)),
        )
        self._gyro_on = gyro
        self._temperature_on = not cycle
        self._counter.restart(round(1e9 / (CYCLE_RATE_HZ if cycle else self.setup.rate_hz)))
        if mode is PowerMode.SLEEP:
            self._mode = None

    def channels(self) -> Sequence[ChannelInfo]:
        return imu_channels(self.name, self.setup, (-40.0, 85.0, 1.0 / 340.0))

    def _empty_fifo(self, *, on: bool) -> None:
        # 4.27: the reset bit works only while the FIFO is switched off
        self._chip.write(m.USER_CTRL, join((m.FIFO_RESET, 1)))
        if on:
            self._chip.write(m.USER_CTRL, join((m.FIFO_ON, 1)))

    def _accel_words(self) -> tuple[int, int, int]:
        x, y, z = struct.unpack(">3h", self._chip.read_block(m.XA_OFFS_H, 6))
        return x, y, z

    def _trim(self) -> tuple[int, int, int]:
        if self._factory is None:
            raise BenchError("offsets need a reset() first: only then the factory's trim is known", device=self.name)
        return self._factory

    def _mean(self, limit_ns: int) -> list[float]:
        """Return the mean counts of accelerometer and gyro over 20 samples, 0.2 s after a change of the settings."""
        wait_s(self._clock, 0.2)
        sums = [0] * 6
        for _ in range(SELF_TEST_SAMPLES):
            if self._clock.now_ns() > limit_ns:
                raise HalTimeout("self-test took too long", device=self.name)
            wait_s(self._clock, 0.001)
            ax, ay, az, _, gx, gy, gz = FRAME.unpack(self._chip.read_block(m.ACCEL_XOUT_H, FRAME.size))
            sums = [s + v for s, v in zip(sums, (ax, ay, az, gx, gy, gz), strict=True)]
        return [s / SELF_TEST_SAMPLES for s in sums]


def celsius(raw: int) -> float:
    """Return degC (RM 4.18, p. 30: 340 counts per degC, 36.53 degC at zero)."""
    return raw / 340.0 + 36.53


def factory_trim(registers: bytes) -> list[float]:
    """Return the counts that the self-test should cause, from ``SELF_TEST_X`` .. ``SELF_TEST_A`` (RM 4.1, p. 10, 11).

    Accelerometer x, y, z at 8 g, then gyro x, y, z at 250 deg/s; 0 where the factory has left no record.
    """
    rest = registers[3]
    accel = [(registers[i] >> 5) << 2 | (rest >> 4 - 2 * i) & 0b11 for i in range(3)]
    gyro = [registers[i] & 0b11111 for i in range(3)]
    trim = [4096 * 0.34 * (0.92 / 0.34) ** ((code - 1) / 30.0) if code else 0.0 for code in accel]
    for code, sign in zip(gyro, (25, -25, 25), strict=True):
        trim.append(sign * 131.0 * 1.046 ** (code - 1) if code else 0.0)
    return trim


def _setup(
    rate_hz: float, accel_range_g: float, gyro_range_dps: float, bandwidth_hz: float | None, name: str
) -> tuple[ImuSetup, tuple[int, int, int, int]]:
    """Return the settings that the chip will use and the bytes of ``SMPLRT_DIV`` .. ``ACCEL_CONFIG`` for them."""
    accel = pick_range(accel_range_g, m.ACCEL_CODES, "accel_range_g", name)
    gyro = pick_range(gyro_range_dps, m.GYRO_CODES, "gyro_range_dps", name)
    divider = math.floor(BASE_RATE_HZ / rate_hz + 1e-6) - 1 if rate_hz > 0 else -1
    if not 0 <= divider <= 255:
        raise BenchError(f"rate_hz = {rate_hz:g} is outside {BASE_RATE_HZ / 256:.1f} .. 1000 Hz", device=name)
    actual_hz = BASE_RATE_HZ / (1 + divider)
    wish_hz = actual_hz / 2 if bandwidth_hz is None else bandwidth_hz
    _, dlpf = pick_bandwidth(wish_hz, {gyro: code for code, (_, gyro) in m.DLPF.items()})
    setup = ImuSetup(
        rate_hz=actual_hz,
        accel_range_g=accel_range_g,
        gyro_range_dps=gyro_range_dps,
        accel_lsb_mps2=STANDARD_GRAVITY * accel_range_g / 32768.0,
        gyro_lsb_rad_s=RAD_PER_DEG / m.GYRO_LSB_PER_DPS[gyro_range_dps],
        accel_bandwidth_hz=m.DLPF[dlpf][0],
        gyro_bandwidth_hz=m.DLPF[dlpf][1],
    )
    return setup, (divider, join((m.DLPF_CFG, dlpf)), join((m.FS_SEL, gyro)), join((m.AFS_SEL, accel)))
