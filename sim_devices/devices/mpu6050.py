"""Emulates the InvenSense MPU-6050: three-axis gyroscope and accelerometer, temperature, 1024-byte FIFO.

Source: MPU-6000/6050 Product Specification rev. 3.4 ("PS") and Register Map and Descriptions rev. 4.2 ("RM", section
numbers in comments); offset registers: InvenSense application note "MPU Hardware Offset Registers" rev. 1.0 but for
the accelerometer's scale. The note prints +-8 g (4096 LSB/g); InvenSense's own Motion Driver 6.12 writes 2048 LSB/g for
this part and calls that "bug fix from +-8G", and the register map of the sister part (RM-MPU-9250A 1.6, registers 119
to 126: +-16 g at every full scale, bit 0 reserved, 15-bit steps of 0.98 mg) gives 2048 LSB/g for the 16-bit word too.
Wire face: I2C register transactions. Truth face: an ``Imu`` (sensing elements on a moving body); observables
``samples`` and ``interrupt``.

Where the documents leave a choice, this device is strict:
- DATA_RDY_INT and FIFO_OFLOW_INT are set only if enabled in INT_ENABLE: "an interrupt is generated" (RM 4.15, 4.16).
- Sensor registers that are read in one transfer come from one sampling instant, that at its START (RM 4.17: the
  user-facing registers are updated only while the bus is idle).
- While the reset bit reads 1 every register reads its reset value and writes are lost.

Model limits
- DLPF: one pole at the bandwidth of RM 4.3; its delay is 1 / (2 pi bandwidth), not the table's. Accelerometer and
  gyroscope are evaluated at the sample rate or at four times the bandwidth, whichever is higher, not always at the
  1 or 8 kHz inside; above 1 kHz the accelerometer repeats (RM 4.2).
- No auxiliary I2C master, DMP, FSYNC, motion interrupt, accelerometer-only cycle mode, clock source or SPI; their
  registers hold what is written. CLKSEL has no effect, the oscillator has one constant ``rate_error``.
- Reset takes 5 ms, start-up from power-on is over, waking from sleep takes PS 6.1's typical 30 ms for valid gyroscope
  data (until then the rates settle exponentially); the PS gives no reset duration.
- Self-test adds a constant response at once; the accelerometer offset registers' bit 0 is stored and otherwise unused.
- TEMP_DIS and the standby bits make their registers keep the last value.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from sim_devices.devices.register_map import Outputs, RegisterFace, SampleClock, signed_limited
from sim_devices.plant.imu import Imu
from sim_devices.plant.sensors import STANDARD_GRAVITY

SMPLRT_DIV, CONFIG, GYRO_CONFIG, ACCEL_CONFIG, FIFO_EN = 0x19, 0x1A, 0x1B, 0x1C, 0x23
INT_PIN_CFG, INT_ENABLE, INT_STATUS, ACCEL_XOUT_H, SENSOR_END = 0x37, 0x38, 0x3A, 0x3B, 0x49
SIGNAL_PATH_RESET, USER_CTRL, PWR_MGMT_1, PWR_MGMT_2 = 0x68, 0x6A, 0x6B, 0x6C
FIFO_COUNT_H, FIFO_COUNT_L, FIFO_R_W, WHO_AM_I = 0x72, 0x73, 0x74, 0x75
XA_OFFS_H, XG_OFFS_H, SELF_TEST_X = 0x06, 0x13, 0x0D

FIFO_BYTES = 1024
RESET_NS = 5_000_000
WAKE_TRANSIENT_DPS, WAKE_TAU_NS = 20.0, 6e6
DATA_RDY, FIFO_OFLOW = 0x01, 0x10
ACCEL_BANDWIDTH_HZ = (260.0, 184.0, 94.0, 44.0, 21.0, 10.0, 5.0, 260.0)  # RM 4.3
GYRO_BANDWIDTH_HZ = (256.0, 188.0, 98.0, 42.0, 20.0, 10.0, 5.0, 256.0)
ACCEL_LSB_PER_G = (16384.0, 8192.0, 4096.0, 2048.0)  # RM 4.17
GYRO_LSB_PER_DPS = (131.0, 65.5, 32.8, 16.4)  # RM 4.19
ACCEL_OFFSET_LSB_PER_G = 2048.0  # +-16 g format: see the module's docstring
GYRO_OFFSET_LSB_PER_DPS = 32.8  # application note: +-1000 dps format
TEMPERATURE_LSB_PER_K, TEMPERATURE_ZERO_C = 340.0, 36.53  # RM 4.18

_STORED = (*range(0x06, 0x0C), *range(0x13, 0x19), 0x1F, 0x20, *range(0x24, 0x35), *range(0x63, 0x68))
_WRITABLE = dict.fromkeys(_STORED, 0xFF) | {
    SMPLRT_DIV: 0xFF,
    CONFIG: 0x3F,
    GYRO_CONFIG: 0xF8,
    ACCEL_CONFIG: 0xF8,
    FIFO_EN: 0xFF,
    INT_PIN_CFG: 0xFE,
    INT_ENABLE: 0x59,
    0x69: 0x3F,
    USER_CTRL: 0x70,
    PWR_MGMT_1: 0x6F,
    PWR_MGMT_2: 0xFF,
}
_RESET = {PWR_MGMT_1: 0x40, WHO_AM_I: 0x68}  # RM 3: all others 0, but for the factory's trim
_TRIM_CODES = (20, 22, 18, 12, 10, 14)  # RM 4.1: accelerometer x, y, z, then gyroscope


def _factory_trim() -> tuple[list[int], list[float]]:
    """Registers 0x0D to 0x10, and the self-test responses that they stand for: g, then dps (RM 4.1)."""
    accel, gyro = _TRIM_CODES[:3], _TRIM_CODES[3:]
    registers = [accel[i] >> 2 << 5 | gyro[i] for i in range(3)]
    registers.append((accel[0] & 3) << 4 | (accel[1] & 3) << 2 | accel[2] & 3)
    response = [0.34 * (0.92 / 0.34) ** ((code - 1) / 30.0) for code in accel]
    response += [sign * 25.0 * 1.046 ** (code - 1) for sign, code in zip((1, -1, 1), gyro, strict=True)]
    return registers, response


class Mpu6050(RegisterFace):
    """Emulates one MPU-6050. The AD0 strap follows from its address on the bus.

    ``rate_error`` = 0.01 makes its clock 1 % fast. ``factory_offsets`` is what the accelerometer offset registers hold
    at power-up: the factory's own correction, which moves with them when they are written.
    """

    def __init__(
        self,
        imu: Imu,
        *,
        rate_error: float = 0.0,
        factory_offsets: tuple[int, int, int] = (-1320, 846, 1788),
    ) -> None:
        if not -0.01 <= rate_error <= 0.01:
            raise ValueError(f"rate_error {rate_error} is outside +-1 % (PS 6.6)")
        trim, response = _factory_trim()
        reset = _RESET | {SELF_TEST_X + i: value for i, value in enumerate(trim)}
        for axis, offset in enumerate(factory_offsets):
            reset[XA_OFFS_H + 2 * axis], reset[XA_OFFS_H + 2 * axis + 1] = (offset & 0xFFFE).to_bytes(2, "big")
        self._imu, self._rate_error = imu, rate_error
        self._factory_lsb = np.array([offset & ~1 for offset in factory_offsets], dtype=np.float64)
        self._self_test = np.array(response) * imu.self_test_gain
        self.samples, self.overflows = 0, 0
        self.fifo: deque[int] = deque()
        self._clock, self._outputs = SampleClock(), Outputs(bytes(14))
        self._transfer_block: bytes | None = None
        super().__init__(reset, _WRITABLE)
        self._set_up()

    def _set_up(self) -> None:
        """Everything a reset clears beside the registers."""
        self.fifo.clear()
        self._clock.halt()
        self._outputs.clear()
        self._last_fifo_byte, self._fifo_count = 0, 0
        self._steps, self._step_of_sample = 1, 0
        self._cleared_ns, self._overflow_ns = -1, -1
        self._reset_due_ns, self._awake_ns = -1, 0
        self._accel, self._gyro = np.zeros(3), np.zeros(3)
        self._accel_ns = -1
        self._block = bytes(14)

    @property
    def interrupt(self) -> bool:
        """Some enabled interrupt is pending (level of a latched INT pin)."""
        return bool(self._flags(1 << 62))

    # ------------------------------------------------------------------ registers

    def start(self, t_ns: int, byte_ns: float) -> None:
        super().start(t_ns, byte_ns)
        self.advance_to(t_ns)
        self._transfer_block = self._outputs.at(t_ns)[1]

    def stop(self) -> None:
        super().stop()
        self._transfer_block = None

    def next_register(self, register: int) -> int:
        return register if register == FIFO_R_W else register + 1 & 0xFF

    def read_register(self, register: int, t_ns: int) -> int:
        value = self._fetch(register, t_ns)
        if register == INT_STATUS or self.registers[INT_PIN_CFG] & 0x10:  # INT_RD_CLEAR, RM 4.14
            self._cleared_ns = t_ns
        return value

    def _fetch(self, register: int, t_ns: int) -> int:
        if ACCEL_XOUT_H <= register < SENSOR_END:
            block = self._outputs.at(t_ns)[1] if self._transfer_block is None else self._transfer_block
            return block[register - ACCEL_XOUT_H]
        if register == INT_STATUS:
            return self._flags(t_ns)
        if register == FIFO_COUNT_H:  # latches both halves, RM 4.31
            self._fifo_count = len(self.fifo)
            return self._fifo_count >> 8
        if register == FIFO_COUNT_L:
            return self._fifo_count & 0xFF
        if register == FIFO_R_W:
            if self.fifo and self.registers[USER_CTRL] & 0x40:
                self._last_fifo_byte = self.fifo.popleft()
            return self._last_fifo_byte
        return self.registers[register]

    def _flags(self, t_ns: int) -> int:
        enabled = self.registers[INT_ENABLE]
        ready = self._outputs.at(t_ns)[0] > self._cleared_ns
        overflow = self._overflow_ns > self._cleared_ns
        return (DATA_RDY if ready else 0) & enabled | (FIFO_OFLOW if overflow else 0) & enabled

    def write_register(self, register: int, value: int, t_ns: int) -> None:
        if self._reset_due_ns >= 0:
            return
        if register == PWR_MGMT_1 and value & 0x80:
            self.load_reset_values()
            self._set_up()
            self._reset_due_ns = t_ns + RESET_NS
            self.registers[PWR_MGMT_1] |= 0x80
            return
        before = self.registers[register]
        super().write_register(register, value, t_ns)
        if register == PWR_MGMT_1 and (before ^ value) & 0x40:
            self._awake_ns = t_ns
            self._run(t_ns)
        elif register in (SMPLRT_DIV, CONFIG) and before != self.registers[register]:
            self._run(t_ns)
        elif register == INT_ENABLE:
            self._cleared_ns = max(self._cleared_ns, t_ns)  # an interrupt is an event after its enabling
        elif register == USER_CTRL:
            self._user_control(value, t_ns)
        elif register == SIGNAL_PATH_RESET and value & 0x07:
            self._outputs.clear()
        elif register == FIFO_R_W and self.registers[USER_CTRL] & 0x40:
            self._to_fifo(bytes((value,)), t_ns)

    def _user_control(self, value: int, t_ns: int) -> None:
        if value & 0x04 and not value & 0x40:  # FIFO_RESET, only while the FIFO is off, RM 4.27
            self.fifo.clear()
            self._fifo_count = 0
        if value & 0x01:  # SIG_COND_RESET
            self._outputs.clear()

    # ------------------------------------------------------------------ sampling

    def next_event_ns(self) -> int | None:
        return None if self.frozen else self._clock.due_ns

    def advance_to(self, t_ns: int) -> None:
        if 0 <= self._reset_due_ns <= t_ns:
            self._reset_due_ns = -1
            self.registers[PWR_MGMT_1] = 0x40
        for due_ns in self._clock.ticks_until(t_ns, frozen=self.frozen):
            self._step(due_ns)

    def _run(self, t_ns: int) -> None:
        if self.registers[PWR_MGMT_1] & 0x40:
            self._clock.halt()
            return
        gyro_hz = 8000.0 if self.registers[CONFIG] & 0x7 in (0, 7) else 1000.0  # RM 4.2
        period_ns = 1e9 * (1 + self.registers[SMPLRT_DIV]) / (gyro_hz * (1.0 + self._rate_error))
        # the filters run at four times their bandwidth or more
        self._steps = max(1, math.ceil(period_ns * 4e-9 * GYRO_BANDWIDTH_HZ[self.registers[CONFIG] & 0x7] - 0.01))
        self._step_of_sample = 0
        self._clock.run(t_ns, period_ns / self._steps)

    def _step(self, t_ns: int) -> None:
        r = self.registers
        filter_code = r[CONFIG] & 0x7
        standby = r[PWR_MGMT_2]
        if self._accel_ns < 0 or t_ns - self._accel_ns > 0.98e6:
            self._accel_ns = t_ns
            self._accel = self._imu.accelerometer.sample(t_ns, ACCEL_BANDWIDTH_HZ[filter_code])
        self._gyro = self._imu.gyroscope.sample(t_ns, GYRO_BANDWIDTH_HZ[filter_code])
        self._step_of_sample += 1
        if self._step_of_sample < self._steps:
            return
        self._step_of_sample = 0
        self.samples += 1
        dps = np.degrees(self._gyro) + WAKE_TRANSIENT_DPS * math.exp(-(t_ns - self._awake_ns) / WAKE_TAU_NS)
        g = self._accel / STANDARD_GRAVITY
        for axis in range(3):
            g[axis] += ((self._word(XA_OFFS_H + 2 * axis) & ~1) - self._factory_lsb[axis]) / ACCEL_OFFSET_LSB_PER_G
            dps[axis] += self._word(XG_OFFS_H + 2 * axis) / GYRO_OFFSET_LSB_PER_DPS
            if r[ACCEL_CONFIG] & 0x80 >> axis:
                g[axis] += self._self_test[axis]
            if r[GYRO_CONFIG] & 0x80 >> axis:
                dps[axis] += self._self_test[3 + axis]
        counts = [signed_limited(v) for v in g * ACCEL_LSB_PER_G[r[ACCEL_CONFIG] >> 3 & 3]]
        kelvin = self._imu.temperature_C(t_ns) - TEMPERATURE_ZERO_C
        counts.append(signed_limited(kelvin * TEMPERATURE_LSB_PER_K))
        counts += [signed_limited(v) for v in dps * GYRO_LSB_PER_DPS[r[GYRO_CONFIG] >> 3 & 3]]
        words = [count.to_bytes(2, "big", signed=True) for count in counts]
        off = [standby & 0x20, standby & 0x10, standby & 0x08, r[PWR_MGMT_1] & 0x08]
        off += [standby & 0x04, standby & 0x02, standby & 0x01]
        for i, idle in enumerate(off):
            if idle:
                words[i] = self._block[2 * i : 2 * i + 2]
        self._block = b"".join(words)
        self._outputs.push(t_ns, self._block)
        if r[USER_CTRL] & 0x40:
            self._to_fifo(self._fifo_frame(words), t_ns)

    def _fifo_frame(self, words: list[bytes]) -> bytes:
        """Build the FIFO frame of the words that FIFO_EN selects, in the order of the registers (RM 4.12)."""
        enabled = self.registers[FIFO_EN]
        frame = b"".join(words[0:3]) if enabled & 0x08 else b""
        for bit, i in ((0x80, 3), (0x40, 4), (0x20, 5), (0x10, 6)):
            if enabled & bit:
                frame += words[i]
        return frame

    def _to_fifo(self, data: bytes, t_ns: int) -> None:
        """Append ``data`` to the FIFO; a full FIFO loses its oldest bytes (RM 4.31)."""
        self.fifo.extend(data)
        if len(self.fifo) > FIFO_BYTES:
            self.overflows += 1
            self._overflow_ns = t_ns
            while len(self.fifo) > FIFO_BYTES:
                self.fifo.popleft()

    def _word(self, register: int) -> int:
        return int.from_bytes(self.registers[register : register + 2], "big", signed=True)
