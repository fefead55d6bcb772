"""Emulates the Bosch BMX055, magnetometer die (that of the BMM150).

Source: BMX055 data sheet BST-BMX055-DS000 rev. 1.3, sections 10 to 12 (power modes, register 0x4A to 0x52, data
formats, repetitions); trim registers 0x5D to 0x71 and the compensation that they are for: BMM150 sensor API (the data
sheet refers to it). Wire face: I2C register transactions at 0x10 to 0x13 (CSB2, SDO2 straps). Truth face: an
``Imu``, whose field this die turns into raw counts by inverting the compensation; observable ``samples``.

In suspend (power control bit 0) only register 0x4B answers; everything else, the chip id too, reads 0. Sleep follows
3 ms after the power bit. A forced measurement and each one in normal mode take 145 us x nXY + 500 us x nZ + 980 us.

Model limits
- The whole measurement sees the field at its end; noise is 1.8 uT / sqrt(repetitions) per axis.
- Normal mode runs at the data rate, or as fast as the repetitions allow if that is slower.
- The self-test always passes, 2 ms after its command in sleep mode (bit 0 of the data LSBs); the advanced self-test
  adds +-100 uT to z. The interrupt engine is stored only; of INT_STATUS only the overflow bit is alive; the DRDY flag
  falls when any data register is read.
- RHALL follows temperature linearly about dig_xyz1; channels that are switched off (0x4E) read the overflow value.
- Soft reset takes 1 ms and ends in sleep mode; an unchanged mode write in normal mode starts the period anew.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_devices.devices.register_map import Outputs, RegisterFace
from sim_devices.plant.imu import Imu
from sim_devices.plant.streams import stream

CHIP_ID, DATA, RHALL, STATUS = 0x40, 0x42, 0x48, 0x4A
POWER, MODE, INT, AXES, REP_XY, REP_Z = 0x4B, 0x4C, 0x4D, 0x4E, 0x51, 0x52
RATES_HZ = (10.0, 2.0, 6.0, 8.0, 15.0, 20.0, 25.0, 30.0)
START_UP_NS, RESET_NS, SELF_TEST_NS = 3_000_000, 1_000_000, 2_000_000
ADVANCED_UT = (0.0, 0.0, -100.0, 100.0)  # self-test current off, off, negative, positive: about 200 uT of difference
NORMAL, FORCED, SLEEP = 0, 1, 3
OVERFLOW_XY, OVERFLOW_Z = -4096, -16384
NOISE_UT = 1.8

_RESET = {CHIP_ID: 0x32, MODE: 0x06, INT: 0x3F, AXES: 0x07}
_WRITABLE = {MODE: 0xFF, INT: 0xFF, AXES: 0xFF, 0x4F: 0xFF, 0x50: 0xFF, REP_XY: 0xFF, REP_Z: 0xFF}


@dataclass(frozen=True)
class Trim:
    """Factory trim by the names of the BMM150 API."""

    x1: int = 0
    y1: int = 0
    x2: int = 26
    y2: int = 26
    z1: int = 23_500
    z2: int = 700
    z3: int = -120
    z4: int = 0
    xy1: int = 29
    xy2: int = -3
    xyz1: int = 6_800

    def registers(self) -> dict[int, int]:
        out = {0x5D: self.x1, 0x5E: self.y1, 0x64: self.x2, 0x65: self.y2, 0x70: self.xy2, 0x71: self.xy1}
        for low, value in ((0x62, self.z4), (0x68, self.z2), (0x6A, self.z1), (0x6C, self.xyz1), (0x6E, self.z3)):
            out[low], out[low + 1] = value, value >> 8
        return {register: value & 0xFF for register, value in out.items()}

    def raw(self, field_uT: NDArray[np.float64], rhall: int) -> tuple[float, float, float]:
        """Counts for which the compensation gives ``field_uT`` (3,): its inverse."""
        ratio = self.xyz1 * 16384.0 / rhall - 16384.0
        common = self.xy2 * ratio * ratio / 268_435_456.0 + ratio * self.xy1 / 16384.0 + 256.0
        x = (field_uT[0] * 16.0 - self.x1 * 8.0) * 8192.0 / (common * (self.x2 + 160.0))
        y = (field_uT[1] * 16.0 - self.y1 * 8.0) * 8192.0 / (common * (self.y2 + 160.0))
        gain = 4.0 * (self.z2 + self.z1 * rhall / 32768.0)
        z = self.z4 + (field_uT[2] * 16.0 * gain + self.z3 * (rhall - self.xyz1)) / 131_072.0
        return x, y, z


class Bmx055Magnetometer(RegisterFace):
    """Emulates the magnetometer die. It powers up in suspend."""

    def __init__(self, imu: Imu, *, trim: Trim | None = None, seed: int = 1) -> None:
        if imu.magnetometer is None:
            raise ValueError("this Imu has no magnetometer")
        self._imu, self._sensor = imu, imu.magnetometer
        self.trim = trim or Trim()
        self._rng = stream(seed, "bmx055.magnetometer.noise")
        self._outputs = Outputs(bytes(8))
        self.samples = 0
        super().__init__(_RESET | self.trim.registers(), _WRITABLE)
        self._set_up(-1)

    def _set_up(self, ready_ns: int) -> None:
        self._ready_ns = ready_ns
        self._due_ns: int | None = None
        self._test_due_ns: int | None = None
        self._read_ns, self._burst_fresh = -1, False
        self._overflow = False
        self._outputs.clear()

    @property
    def conversion_ns(self) -> int:
        n_xy, n_z = 1 + 2 * self.registers[REP_XY], 1 + self.registers[REP_Z]
        return 145_000 * n_xy + 500_000 * n_z + 980_000

    # ------------------------------------------------------------------ registers

    def read_register(self, register: int, t_ns: int) -> int:
        if register == POWER:
            return self.registers[POWER]
        if not self.registers[POWER] & 1 or t_ns < self._ready_ns:
            return 0
        if DATA <= register < DATA + 8:
            sampled_ns, block = self._outputs.at(t_ns)
            fresh = sampled_ns > self._read_ns
            if register < RHALL:
                self._burst_fresh |= fresh
                self._read_ns = sampled_ns
            ready = register == RHALL and (fresh or self._burst_fresh)
            return block[register - DATA] | ready
        if register == STATUS:
            return 0x40 if self._overflow else 0
        return self.registers[register]

    def read(self, n: int, t_ns: int) -> bytes:
        """A burst over data and RHALL shows DRDY as it was for the data that it has just read."""
        self._burst_fresh = False
        return super().read(n, t_ns)

    def write_register(self, register: int, value: int, t_ns: int) -> None:
        if register == POWER:
            self._power(value, t_ns)
            return
        if not self.registers[POWER] & 1 or t_ns < self._ready_ns:
            return
        super().write_register(register, value, t_ns)
        if register == MODE:
            self._begin(t_ns)

    def _power(self, value: int, t_ns: int) -> None:
        on = value & 0x01
        was_on = self.registers[POWER] & 0x01
        if value & 0x82 == 0x82 and was_on:  # soft reset: all but the power control register
            self.load_reset_values()
            self._set_up(t_ns + RESET_NS)
        elif not on:  # suspend
            self.load_reset_values()
            self._set_up(-1)
        elif not was_on:
            self._set_up(t_ns + START_UP_NS)
        self.registers[POWER] = on | value & 0x04

    def _begin(self, t_ns: int) -> None:
        mode = self.registers[MODE] >> 1 & 3
        self._due_ns = t_ns + self.conversion_ns if mode in (NORMAL, FORCED) else None
        if mode == SLEEP and self.registers[MODE] & 0x01:
            self._test_due_ns = t_ns + SELF_TEST_NS

    # ------------------------------------------------------------------ sampling

    def next_event_ns(self) -> int | None:
        return None if self.frozen else self._due_ns

    def advance_to(self, t_ns: int) -> None:
        if self._test_due_ns is not None and self._test_due_ns <= t_ns and not self.frozen:
            block = self._outputs.at(t_ns)[1]
            passed = bytes(byte | (0x01 if i in (0, 2, 4) else 0) for i, byte in enumerate(block))
            self._outputs.push(self._test_due_ns, passed)
            self._read_ns = self._test_due_ns  # that is no new measurement
            self._test_due_ns = None
            self.registers[MODE] &= 0xFE
        while self._due_ns is not None and self._due_ns <= t_ns:
            due_ns = self._due_ns
            if self.registers[MODE] >> 1 & 3 == NORMAL:
                period_ns = round(1e9 / RATES_HZ[self.registers[MODE] >> 3 & 7])
                self._due_ns = due_ns + max(period_ns, self.conversion_ns)
            else:
                self._due_ns = None
                self.registers[MODE] |= SLEEP << 1  # a forced measurement ends in sleep mode
            if not self.frozen:
                self._sample(due_ns)

    def _sample(self, t_ns: int) -> None:
        self.samples += 1
        n_xy, n_z = 1 + 2 * self.registers[REP_XY], 1 + self.registers[REP_Z]
        sigma = NOISE_UT / np.sqrt([n_xy, n_xy, n_z])
        field_uT = self._sensor.sample(t_ns, 1e3) + sigma * self._noise()
        field_uT[2] += ADVANCED_UT[self.registers[MODE] >> 6]
        rhall = min(0x3FFF, max(1, round(self.trim.xyz1 * (1.0 + 5e-4 * (self._imu.temperature_C(t_ns) - 25.0)))))
        words: list[int] = []
        self._overflow = False
        for axis, counts in enumerate(self.trim.raw(field_uT, rhall)):
            overflow = OVERFLOW_Z if axis == 2 else OVERFLOW_XY
            off = self.registers[AXES] & (0x08 << axis)
            beyond = not math.isfinite(counts) or abs(counts) >= -overflow - 1
            self._overflow |= bool(beyond)
            words.append(overflow if off or beyond else round(counts))
        x, y, z = words
        packed = ((x << 3) & 0xFFFF, (y << 3) & 0xFFFF, (z << 1) & 0xFFFF, rhall << 2 & 0xFFFF)
        self._outputs.push(t_ns, b"".join(word.to_bytes(2, "little") for word in packed))

    def _noise(self) -> NDArray[np.float64]:
        """Return noise (3,) of unit variance, less for a better unit and none for an ideal one."""
        return self._rng.standard_normal(3) * self._imu.noise
