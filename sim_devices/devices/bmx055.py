"""Emulates the Bosch BMX055, accelerometer die (12 bit) and gyroscope die (16 bit); its magnetometer is in
``bmx055_magnetometer``.

Source: BMX055 data sheet BST-BMX055-DS000 rev. 1.3, sections 4 to 6 (accelerometer, "A") and 7 to 9 (gyroscope,
"G"); bit places of the gyroscope's offset registers also from the BMG160 data sheet. Three dies share one package and
nothing else: each has its own address, soft reset, clock and power modes. Wire face: I2C register transactions. Truth
face: an ``Imu``; observable ``samples``.

A channel's MSB is locked when its LSB is read and until it is read itself (shadowing, unless shadow_dis): x and z of
one burst may belong to neighbouring samples, a FIFO frame does not.

Model limits
- One pole at the selected bandwidth. The accelerometer's low-power modes sample as in normal mode; sleep phases,
  power save and deep suspend's loss of registers are not modelled (deep suspend is suspend).
- A read during the start-up after a soft reset gives 0, a write is lost (1.8 ms; gyroscope 30 ms).
- Of the interrupts only the status bits of new data and FIFO exist; no slope, tap, orientation, high-rate engines, no
  pins, no watchdog, no SPI. New data not latched shows for 50 us (gyroscope 300 us).
- FIFO: what is left of a frame when a read segment ends is lost; an empty FIFO reads 0 (gyroscope 0x8000 words); the
  external trigger and tag bits are not modelled.
- Compensation: fast (one shot) only; slow compensation registers are stored. NVM programming takes 10 ms; a
  programming without cycles left or without prog_mode does nothing.
- The gyroscope's built-in self-test always passes, 1 ms after its trigger.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_devices.devices.bmx055_die import (
    BANDWIDTH,
    CHIP_ID,
    FIFO_CONFIG_1,
    HIGH_BANDWIDTH,
    INT_STATUS_1,
    LATCH,
    LPM1,
    NVM_CONTROL,
    RANGE,
    TEMPERATURE,
    Die,
    DieFacts,
)
from sim_devices.devices.register_map import signed_byte, signed_limited
from sim_devices.plant.imu import Imu
from sim_devices.plant.sensors import STANDARD_GRAVITY

A_SELF_TEST, A_OFFSET_CONTROL, A_OFFSET_TARGET, A_OFFSET_X, A_WATERMARK = 0x32, 0x36, 0x37, 0x38, 0x30
A_LSB_PER_G = {0x3: 1024.0, 0x5: 512.0, 0x8: 256.0, 0xC: 128.0}  # A, register 0x0F
A_OFFSET_G = 7.81e-3  # per LSB, whatever the range (A, register 0x38)
A_SELF_TEST_G = (0.95, 0.9, 0.5)  # one direction, amplitude bit set; the difference must exceed 0.8, 0.8, 0.4 g

G_FAST_OFFSET, G_OFC1, G_TRIM_GP0, G_BIST, G_WATERMARK = 0x32, 0x36, 0x3A, 0x3C, 0x3D
G_LSB_PER_DPS = (16.4, 32.8, 65.6, 131.2, 262.4)
G_RATES = (
    (2000.0, 523.0),
    (2000.0, 230.0),
    (1000.0, 116.0),
    (400.0, 47.0),
    (200.0, 23.0),
    (100.0, 12.0),
    (200.0, 64.0),
    (100.0, 32.0),
)
G_OFFSET_DPS = 0.061  # per LSB of the 12-bit offset


class Bmx055Accelerometer(Die):
    """Emulates the accelerometer die at address 0x18 or 0x19 (SDO1). It wakes up measuring at +-2 g, 1 kHz."""

    def __init__(self, imu: Imu, *, start_ns: int = 0) -> None:
        facts = DieFacts(1_800_000, 50_000, 32, b"\0\0", (A_OFFSET_X, 0x3C))
        reset = {CHIP_ID: 0xFA, RANGE: 0x03, BANDWIDTH: 0x0F, 0x20: 0x05, A_OFFSET_CONTROL: 0x10}
        reset |= dict(zip(range(0x22, 0x2E), bytes.fromhex("0930810fc0001414040a1808"), strict=True))
        masks = dict.fromkeys((*range(0x16, 0x1C), 0x1E, *range(0x20, 0x2F), 0x12, 0x34, 0x37), 0xFF)
        masks |= {RANGE: 0x0F, BANDWIDTH: 0x1F, LPM1: 0xFE, HIGH_BANDWIDTH: 0xC0, A_WATERMARK: 0x3F, A_SELF_TEST: 0x17}
        masks |= {NVM_CONTROL: 0x01, A_OFFSET_CONTROL: 0x07, FIFO_CONFIG_1: 0xC3} | dict.fromkeys(
            range(0x38, 0x3D), 0xFF
        )
        super().__init__(facts, reset, masks, imu, start_ns)

    def _bandwidth_hz(self) -> float:
        code = self.registers[BANDWIDTH] & 0x1F
        if self.registers[HIGH_BANDWIDTH] & 0x80 or code >= 0x0F:
            return 1000.0
        return 7.8125 * 2.0 ** max(0, code - 8)

    def _rate_hz(self) -> float:
        return 2.0 * self._bandwidth_hz()

    def _new_data_enabled(self) -> bool:
        return bool(self.registers[0x17] & 0x10)

    def _watermark(self) -> int:
        return self.registers[A_WATERMARK]

    def _with_flag(self, low: int, fresh: bool) -> int:
        return low | fresh

    def read_register(self, register: int, t_ns: int) -> int:
        if register == INT_STATUS_1 and t_ns >= self._ready_ns:
            enabled, waiting = self.registers[0x17], len(self.fifo)
            value = 0x80 if self._new_data(t_ns) else 0
            value |= 0x40 if enabled & 0x40 and 0 < self._watermark() <= waiting else 0
            return value | (0x20 if enabled & 0x20 and waiting >= self._facts.fifo_frames else 0)
        return super().read_register(register, t_ns)

    def write_register(self, register: int, value: int, t_ns: int) -> None:
        super().write_register(register, value, t_ns)
        if register == A_OFFSET_CONTROL and t_ns >= self._ready_ns:
            if value & 0x80:
                self.registers[A_OFFSET_X : A_OFFSET_X + 3] = bytes(3)
            if value & 0x60 and self._averaging is None:
                self._averaging, self._axis = [], (value >> 5 & 3) - 1
                self.registers[A_OFFSET_CONTROL] &= 0xEF  # cal_rdy

    def _measure(self, t_ns: int) -> list[int]:
        r = self.registers
        g = self._imu.accelerometer.sample(t_ns, self._bandwidth_hz()) / STANDARD_GRAVITY
        mean = self._average(g, 16)
        if mean is not None:
            target_g = (0.0, 1.0, -1.0, 0.0)[r[A_OFFSET_TARGET] >> 1 + 2 * self._axis & 3]
            r[A_OFFSET_X + self._axis] = signed_limited((target_g - mean[self._axis]) / A_OFFSET_G, 8) & 0xFF
            r[A_OFFSET_CONTROL] |= 0x10
        scale = A_LSB_PER_G.get(r[RANGE] & 0x0F, 1024.0)
        words: list[int] = []
        for axis in range(3):
            value = g[axis] + signed_byte(r[A_OFFSET_X + axis]) * A_OFFSET_G
            if r[A_SELF_TEST] & 3 == axis + 1:
                amplitude = (
                    A_SELF_TEST_G[axis] * self._imu.self_test_gain[axis] * (1.0 if r[A_SELF_TEST] & 0x10 else 0.5)
                )
                value += amplitude if r[A_SELF_TEST] & 0x04 else -amplitude
            words.append((signed_limited(value * scale, 12) & 0xFFF) << 4)
        return words


class Bmx055Gyroscope(Die):
    """Emulates the gyroscope die at address 0x68 or 0x69 (SDO2), like the MPU-6050. It wakes up measuring at 2000 dps,
    2 kHz."""

    def __init__(self, imu: Imu, *, start_ns: int = 0) -> None:
        facts = DieFacts(30_000_000, 300_000, 100, b"\x00\x80", (G_OFC1, 0x3B))
        reset = {CHIP_ID: 0x0F, BANDWIDTH: 0x80, 0x16: 0x0F, 0x31: 0x40, G_FAST_OFFSET: 0xC0, G_BIST: 0x10}
        masks = dict.fromkeys((0x12, 0x15, 0x16, 0x17, 0x18, 0x1A, 0x1B, 0x1C, 0x1E, LATCH, 0x31, 0x34, 0x3D), 0xFF)
        masks |= {RANGE: 0x07, BANDWIDTH: 0x0F, LPM1: 0xAE, HIGH_BANDWIDTH: 0xC0, G_FAST_OFFSET: 0xFF, G_BIST: 0x00}
        masks |= {NVM_CONTROL: 0x01, FIFO_CONFIG_1: 0xC3} | dict.fromkeys(range(0x22, 0x28), 0xFF)
        masks |= dict.fromkeys(range(G_OFC1, G_BIST), 0xFF)
        self._bist_due_ns = -1
        super().__init__(facts, reset, masks, imu, start_ns)

    def _filter(self) -> tuple[float, float]:
        return (2000.0, 523.0) if self.registers[HIGH_BANDWIDTH] & 0x80 else G_RATES[self.registers[BANDWIDTH] & 7]

    def _rate_hz(self) -> float:
        return self._filter()[0]

    def _new_data_enabled(self) -> bool:
        return bool(self.registers[0x15] & 0x80)

    def _watermark(self) -> int:
        return self.registers[G_WATERMARK] & 0x7F

    def read_register(self, register: int, t_ns: int) -> int:
        if t_ns >= self._ready_ns:
            if register == TEMPERATURE:
                return 0  # reserved on this die
            if register == INT_STATUS_1:
                full = 0 < self._watermark() <= len(self.fifo) or len(self.fifo) >= self._facts.fifo_frames
                value = 0x80 if self._new_data(t_ns) else 0
                return value | (0x10 if self.registers[0x15] & 0x40 and full else 0)
            if register == G_BIST:
                return 0x10 | (0x02 if 0 <= self._bist_due_ns <= t_ns else 0)
        return super().read_register(register, t_ns)

    def write_register(self, register: int, value: int, t_ns: int) -> None:
        super().write_register(register, value, t_ns)
        if t_ns < self._ready_ns:
            return
        if register == G_BIST and value & 0x01:
            self._bist_due_ns = t_ns + 1_000_000
        elif register == G_FAST_OFFSET and value & 0x08 and value & 0x07 and self._averaging is None:
            self._averaging = []

    def offsets_dps(self) -> NDArray[np.float64]:
        """(3,) what the offset registers subtract or add, 12 bits each, spread over OFC1..4 and TRIM_GP0."""
        r = self.registers
        ofc1, low = r[G_OFC1], r[G_TRIM_GP0]
        raw = (
            r[G_OFC1 + 1] << 4 | ofc1 >> 6 << 2 | low >> 2 & 3,
            r[G_OFC1 + 2] << 4 | (ofc1 >> 3 & 7) << 1 | low >> 1 & 1,
            r[G_OFC1 + 3] << 4 | (ofc1 & 7) << 1 | low & 1,
        )
        return np.array([value - 0x1000 if value & 0x800 else value for value in raw]) * G_OFFSET_DPS

    def _store_offset(self, axis: int, dps: float) -> None:
        raw = signed_limited(dps / G_OFFSET_DPS, 12) & 0xFFF
        r = self.registers
        r[G_OFC1 + 1 + axis] = raw >> 4
        middle_at, middle_bits, low_at = ((6, 2, 2), (3, 3, 1), (0, 3, 0))[axis]
        low_bits = 4 - middle_bits
        middle, low = (1 << middle_bits) - 1, (1 << low_bits) - 1
        r[G_OFC1] = r[G_OFC1] & ~(middle << middle_at) & 0xFF | (raw >> low_bits & middle) << middle_at
        r[G_TRIM_GP0] = r[G_TRIM_GP0] & ~(low << low_at) & 0xFF | (raw & low) << low_at

    def _measure(self, t_ns: int) -> list[int]:
        r = self.registers
        dps = np.degrees(self._imu.gyroscope.sample(t_ns, self._filter()[1]))
        mean = self._average(dps, 32 << (r[G_FAST_OFFSET] >> 4 & 3))
        if mean is not None:
            for axis in range(3):
                if r[G_FAST_OFFSET] >> axis & 1:
                    self._store_offset(axis, -mean[axis])
            r[G_FAST_OFFSET] &= 0xF7
        scale = G_LSB_PER_DPS[min(r[RANGE] & 7, 4)]
        return [signed_limited(value) & 0xFFFF for value in (dps + self.offsets_dps()) * scale]
