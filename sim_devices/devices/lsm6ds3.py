"""Emulates the ST LSM6DS3: three-axis accelerometer and gyroscope, temperature, 4096-word FIFO.

Source: LSM6DS3 data sheet DocID026899 rev. 10 ("DS", section numbers in comments) and application note AN4650 rev. 5
("AN"). Wire face: I2C register transactions. Truth face: an ``Imu`` (sensing elements on a moving body); observables
``samples`` (accelerometer, gyroscope).

A sample's output registers change while a burst goes on unless BDU is set: then a register pair whose one half has
been read keeps its value until the other half is read (DS 9.14), so x and z of a long burst may still belong to
neighbouring samples. XLDA, GDA and TDA fall when a high byte of their group is read (AN 4.1).

Model limits
- One pole at the accelerometer's anti-aliasing bandwidth (DS 9.12), at a third of the data rate for the gyroscope;
  composite filters, high-pass, slope filter, CTRL8_XL and the low-power modes (XL_HM_MODE, G_HM_MODE) are stored only.
- After power-down the gyroscope's output decays to the truth within 80 ms (AN 3.9); the accelerometer is right at once.
- No embedded functions, interrupts pins, timestamp, sensor hub, rounding, big-endian mode or SPI. FUNC_CFG_ACCESS is
  stored but does not switch banks.
- FIFO: modes bypass, FIFO and continuous; the trigger modes act like bypass. Third and fourth data sets, ONLY_HIGH_DATA
  and STOP_ON_FTH are not modelled. Each set is written at the FIFO's rate, decimated, from the newest sample.
- The temperature sensor updates at 52 Hz whatever runs; boot and software reset take 15 ms and 50 us (AN 3.3, 5.7).
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from sim_devices.devices.register_map import Outputs, RegisterFace, SampleClock, signed_limited
from sim_devices.plant.imu import Imu
from sim_devices.plant.sensors import STANDARD_GRAVITY

FIFO_CTRL1, FIFO_CTRL2, FIFO_CTRL3, FIFO_CTRL4, FIFO_CTRL5 = range(0x06, 0x0B)
WHO_AM_I, CTRL1_XL, CTRL2_G, CTRL3_C, CTRL4_C, CTRL5_C = range(0x0F, 0x15)
CTRL9_XL, CTRL10_C, STATUS_REG, OUT_TEMP_L, OUTX_L_G, OUTX_L_XL = 0x18, 0x19, 0x1E, 0x20, 0x22, 0x28
FIFO_STATUS1, FIFO_STATUS2, FIFO_STATUS3, FIFO_STATUS4, FIFO_DATA_OUT_L, FIFO_DATA_OUT_H = range(0x3A, 0x40)

RATES_HZ = (0.0, 12.5, 26.0, 52.0, 104.0, 208.0, 416.0, 833.0, 1660.0, 3330.0, 6660.0)  # DS Table 45, 48
MG_PER_LSB = (0.061, 0.488, 0.122, 0.244)  # FS_XL 00 2 g, 01 16 g, 10 4 g, 11 8 g (DS Table 3)
ACCEL_BANDWIDTH_HZ = (400.0, 200.0, 100.0, 50.0)
MDPS_PER_LSB = (8.75, 17.5, 35.0, 70.0)  # FS_G 245, 500, 1000, 2000 dps
MDPS_PER_LSB_125 = 4.375
TEMPERATURE_HZ, TEMPERATURE_LSB_PER_K = 52.0, 16.0
DECIMATION = (0, 1, 2, 3, 4, 8, 16, 32)
FIFO_WORDS = 4095  # DIFF_FIFO has 12 bits; the memory is 8 kbyte
BOOT_NS, RESET_NS = 15_000_000, 50_000
TURN_ON_DPS, TURN_ON_TAU_NS = 30.0, 12e6
SELF_TEST_G = (0.4, 0.35, 0.5)  # DS Table 3: 90 to 1700 mg
SELF_TEST_DPS = (60.0, 52.0, 55.0)  # 20 to 80 dps at 245 dps; 150 to 700 dps at 2000 dps
SELF_TEST_DPS_HIGH = (400.0, 360.0, 380.0)
TEMPERATURE, GYRO, ACCEL = range(3)  # groups of output registers, and bits TDA, GDA, XLDA from the left
_FIRST = (OUT_TEMP_L, OUTX_L_G, OUTX_L_XL)
_FLAG = (0x04, 0x02, 0x01)

_RESET = {WHO_AM_I: 0x69, CTRL3_C: 0x04, CTRL9_XL: 0x38, CTRL10_C: 0x38}  # DS 8
_WRITABLE = dict.fromkeys(
    (0x01, 0x04, 0x06, 0x08, 0x0B, 0x0D, 0x0E, 0x11, 0x12, 0x13, 0x14, 0x15, 0x16, 0x17), 0xFF
) | {
    FIFO_CTRL2: 0xCF,
    FIFO_CTRL3: 0x3F,
    FIFO_CTRL4: 0x7F,
    FIFO_CTRL5: 0x7F,
    CTRL1_XL: 0xFF,
    CTRL2_G: 0xFE,
    CTRL3_C: 0x7E,
    CTRL5_C: 0xEF,
    CTRL9_XL: 0x3C,
    CTRL10_C: 0x3F,
    0x1A: 0xDF,
    **dict.fromkeys(range(0x58, 0x60), 0xFF),
}


class Lsm6ds3(RegisterFace):
    """Emulates one LSM6DS3. The SA0 strap follows from its address on the bus. ``rate_error``: its clock runs fast."""

    def __init__(self, imu: Imu, *, rate_error: float = 0.0) -> None:
        if not -0.1 <= rate_error <= 0.1:
            raise ValueError(f"rate_error {rate_error} is outside +-10 %")
        self._imu, self._rate_error = imu, rate_error
        self._clocks = (SampleClock(), SampleClock(), SampleClock())
        self._fifo_clock = SampleClock()
        self._outputs = (Outputs(bytes(2)), Outputs(bytes(6)), Outputs(bytes(6)))
        self.samples = [0, 0]
        self.fifo: deque[tuple[int, bytes]] = deque()
        self.overruns = 0
        super().__init__(_RESET, _WRITABLE)
        self._set_up()

    def _set_up(self) -> None:
        for clock in (*self._clocks, self._fifo_clock):
            clock.halt()
        for outputs in self._outputs:
            outputs.clear()
        self._read_ns = [-1, -1, -1]  # when a high byte of the group was read last
        self._held: dict[int, bytes] = {}  # first register of a pair -> its bytes, while BDU guards it
        self._busy_until_ns = -1
        self._gyro_on_ns = 0
        self._empty_fifo()

    def _empty_fifo(self) -> None:
        self.fifo.clear()
        self._fifo_overrun = False
        self._fifo_sets = 0
        self._fifo_word = b"\0\0"

    # ------------------------------------------------------------------ registers

    def next_register(self, register: int) -> int:
        if not self.registers[CTRL3_C] & 0x04:  # IF_INC
            return register
        return FIFO_DATA_OUT_L if register == FIFO_DATA_OUT_H else register + 1 & 0xFF  # wraps while reading the FIFO

    def read_register(self, register: int, t_ns: int) -> int:
        if OUT_TEMP_L <= register < OUTX_L_XL + 6:
            return self._output(register, t_ns)
        if register == STATUS_REG:
            return sum(flag for group, flag in enumerate(_FLAG) if self._fresh(group, t_ns))
        if FIFO_STATUS1 <= register <= FIFO_STATUS4:
            return self._fifo_status(register)
        if register == FIFO_DATA_OUT_L:
            if self.fifo:
                self._fifo_word = self.fifo.popleft()[1]
                self._fifo_overrun = False
            return self._fifo_word[0]
        if register == FIFO_DATA_OUT_H:
            return self._fifo_word[1]
        return self.registers[register]

    def _fresh(self, group: int, t_ns: int) -> bool:
        return self._outputs[group].at(t_ns)[0] > self._read_ns[group]

    def _output(self, register: int, t_ns: int) -> int:
        group = TEMPERATURE if register < OUTX_L_G else GYRO if register < OUTX_L_XL else ACCEL
        pair, half = register & ~1, register & 1
        offset = pair - _FIRST[group]
        word = self._outputs[group].at(t_ns)[1][offset : offset + 2]
        if self.registers[CTRL3_C] & 0x40:  # BDU
            if pair in self._held:
                word = self._held.pop(pair)
            else:
                self._held[pair] = word
        if half:
            self._read_ns[group] = t_ns
        return word[half]

    def _fifo_status(self, register: int) -> int:
        waiting = len(self.fifo)
        if register == FIFO_STATUS1:
            return waiting & 0xFF
        if register == FIFO_STATUS2:
            threshold = self.registers[FIFO_CTRL1] | (self.registers[FIFO_CTRL2] & 0x0F) << 8
            value = waiting >> 8
            value |= 0x80 if threshold and waiting >= threshold else 0
            value |= 0x40 if self._fifo_overrun else 0
            value |= 0x20 if waiting >= FIFO_WORDS - 6 else 0
            return value | (0x10 if not waiting else 0)
        pattern = self.fifo[0][0] if self.fifo else 0
        return pattern & 0xFF if register == FIFO_STATUS3 else pattern >> 8

    def write_register(self, register: int, value: int, t_ns: int) -> None:
        if t_ns < self._busy_until_ns:
            return
        if register == CTRL3_C and value & 0x81:
            self.load_reset_values()
            self._set_up()
            self._busy_until_ns = t_ns + (BOOT_NS if value & 0x80 else RESET_NS)
            self.registers[CTRL3_C] |= value & 0x81
            return
        before = self.registers[register]
        super().write_register(register, value, t_ns)
        if register == CTRL1_XL and (before ^ value) & 0xF0:
            self._run(ACCEL, value >> 4, t_ns)
        elif register == CTRL2_G and (before ^ value) & 0xF0:
            if not before & 0xF0:
                self._gyro_on_ns = t_ns
            self._run(GYRO, min(value >> 4, 8), t_ns)
        elif register == FIFO_CTRL5:
            self._run_fifo(before, value, t_ns)

    def _period_ns(self, rate_hz: float) -> float:
        return 1e9 / (rate_hz * (1.0 + self._rate_error))

    def _run(self, group: int, code: int, t_ns: int) -> None:
        if 0 < code < len(RATES_HZ):
            self._clocks[group].run(t_ns, self._period_ns(RATES_HZ[code]))
        else:
            self._clocks[group].halt()
        if any(clock.due_ns is not None for clock in self._clocks[1:]):
            if self._clocks[TEMPERATURE].due_ns is None:
                self._clocks[TEMPERATURE].run(t_ns, self._period_ns(TEMPERATURE_HZ))
        else:
            self._clocks[TEMPERATURE].halt()

    def _run_fifo(self, before: int, value: int, t_ns: int) -> None:
        rate, mode = value >> 3 & 0xF, value & 0x7
        if mode in (1, 6) and 0 < rate < len(RATES_HZ):
            if (before ^ value) & 0x7F:
                # a shade after the sensors' own instant, so that the set holds that sample
                self._fifo_clock.run(t_ns, self._period_ns(RATES_HZ[rate]))
        else:
            self._fifo_clock.halt()
        if mode == 0:
            self._empty_fifo()

    # ------------------------------------------------------------------ sampling

    def next_event_ns(self) -> int | None:
        if self.frozen:
            return None
        due = [c.due_ns for c in (*self._clocks, self._fifo_clock) if c.due_ns is not None]
        return min(due) if due else None

    def advance_to(self, t_ns: int) -> None:
        if 0 <= self._busy_until_ns <= t_ns:
            self._busy_until_ns = -1
            self.registers[CTRL3_C] &= 0x7E
        clocks = (*self._clocks, self._fifo_clock)  # at one instant the FIFO comes last
        if self.frozen:
            for clock in clocks:
                clock.skip_past(t_ns)
        while True:
            running = [c for c in clocks if c.due_ns is not None and c.due_ns <= t_ns]
            if not running:
                return
            clock = min(running, key=lambda c: c.due_ns or 0)
            due_ns = clock.due_ns or 0
            clock.tick()
            if clock is self._fifo_clock:
                self._write_fifo()
            else:
                self._sample(self._clocks.index(clock), due_ns)

    def _sample(self, group: int, t_ns: int) -> None:
        r = self.registers
        if group == TEMPERATURE:
            counts = [signed_limited((self._imu.temperature_C(t_ns) - 25.0) * TEMPERATURE_LSB_PER_K)]
        elif group == ACCEL:
            self.samples[0] += 1
            g = self._imu.accelerometer.sample(t_ns, ACCEL_BANDWIDTH_HZ[r[CTRL1_XL] & 3]) / STANDARD_GRAVITY
            sign = (0.0, 1.0, -1.0, 0.0)[r[CTRL5_C] & 3]
            g = g + sign * np.array(SELF_TEST_G) * self._imu.self_test_gain[:3]
            counts = [signed_limited(v) for v in g * 1000.0 / MG_PER_LSB[r[CTRL1_XL] >> 2 & 3]]
        else:
            self.samples[1] += 1
            dps = np.degrees(self._imu.gyroscope.sample(t_ns, RATES_HZ[min(r[CTRL2_G] >> 4, 8)] / 3.0))
            dps = dps + TURN_ON_DPS * math.exp(-(t_ns - self._gyro_on_ns) / TURN_ON_TAU_NS)
            fine, scale = bool(r[CTRL2_G] & 0x02), r[CTRL2_G] >> 2 & 3
            sign = (0.0, 1.0, 0.0, -1.0)[r[CTRL5_C] >> 2 & 3]
            response = SELF_TEST_DPS_HIGH if scale == 3 and not fine else SELF_TEST_DPS
            dps = dps + sign * np.array(response) * self._imu.self_test_gain[3:]
            counts = [signed_limited(v) for v in dps * 1000.0 / (MDPS_PER_LSB_125 if fine else MDPS_PER_LSB[scale])]
        enabled = {ACCEL: r[CTRL9_XL] >> 3, GYRO: r[CTRL10_C] >> 3, TEMPERATURE: 7}[group]
        words = [count.to_bytes(2, "little", signed=True) for count in counts]
        block = b"".join(word if enabled >> i & 1 else b"\0\0" for i, word in enumerate(words))
        self._outputs[group].push(t_ns, block)

    def _write_fifo(self) -> None:
        """Write one set: gyroscope x y z, then accelerometer x y z, each by its own decimation (DS 9.5)."""
        decimation = self.registers[FIFO_CTRL3]
        pattern = 0
        for group, factor in ((GYRO, DECIMATION[decimation >> 3 & 7]), (ACCEL, DECIMATION[decimation & 7])):
            if not factor:
                continue
            if self._fifo_sets % factor == 0:
                block = self._outputs[group].at(1 << 62)[1]
                for i in range(3):
                    self._to_fifo(pattern + i, block[2 * i : 2 * i + 2])
            pattern += 3
        self._fifo_sets += 1

    def _to_fifo(self, pattern: int, word: bytes) -> None:
        if len(self.fifo) >= FIFO_WORDS:
            self.overruns += 1
            if self.registers[FIFO_CTRL5] & 7 == 1:  # FIFO mode stops when full
                return
            self._fifo_overrun = True
            self.fifo.popleft()
        self.fifo.append((pattern, word))
