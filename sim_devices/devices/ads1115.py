"""Emulates the Texas Instruments ADS1115: 16-bit delta-sigma ADC on I2C, four inputs, comparator.

Source: ADS111x data sheet SBAS444: Operating Modes, Data Rate and Conversion Time, Comparator, Conversion Ready
Pin, Reset and Power-Up (general call 06h), Register Map (pointer, conversion, config, Lo_thresh, Hi_thresh).
Wire face: I2C segments. Truth face: a callable that gives the four input voltages (V against GND) at an instant;
observable ``alert_asserted``.

Model limits
- The modulator's averaging is a trapezoid over ``looks`` equal parts of one conversion; with one look the mean of the
  inputs at its start and end.
- No noise, offset or gain error, no input impedance; inputs beyond GND..VDD are measured as if allowed.
- The data rate has one constant error (data sheet: +-10 %) instead of a drifting oscillator; the 25 us wake-up
  of a single shot is added. A config write during a conversion lets it end with the old settings.
- Reads longer than two bytes repeat the register; the upper six pointer bits are ignored; a register write with
  one data byte is dropped. High-speed mode (3.4 MHz) and the SMBus alert response are not modelled.
- ``alert_asserted`` ignores the 8 us pulse of the conversion-ready mode: it stays until the next conversion.
"""

from __future__ import annotations

import numpy as np

from sim_devices.faces import VoltageSource

CONVERSION, CONFIG, LO_THRESH, HI_THRESH = range(4)
RESET_VALUES = (0x0000, 0x8583, 0x8000, 0x7FFF)  # Register Map
FULL_SCALE_V = (6.144, 4.096, 2.048, 1.024, 0.512, 0.256, 0.256, 0.256)  # PGA[2:0]
RATES_HZ = (8, 16, 32, 64, 128, 250, 475, 860)  # DR[2:0]
MUX = ((0, 1), (0, 3), (1, 3), (2, 3), (0, None), (1, None), (2, None), (3, None))
WAKE_UP_NS = 25_000
RESET_COMMAND = 0x06
OS_BIT, MODE_BIT = 0x8000, 0x0100


class Ads1115:
    """Emulates one ADS1115. ``rate_error`` = 0.05 makes conversions 5 % faster than the nominal data rate."""

    def __init__(self, inputs: VoltageSource, *, rate_error: float = 0.0, looks: int = 1) -> None:
        if not -0.1 <= rate_error <= 0.1:
            raise ValueError(f"rate_error {rate_error} is outside the data sheet's +-10 %")
        self.nack_address = False
        self.nack_data = False
        self.frozen = False
        self.always_ready = False  # fault hook: the OS bit says so even while a conversion runs
        self.conversions = 0
        self._inputs = inputs
        self._rate_error = rate_error
        self._looks = looks
        self._reset()

    def _reset(self) -> None:
        self.registers: list[int] = list(RESET_VALUES)
        self.alert_asserted = False
        self._pointer = 0
        self._due_ns: int | None = None
        self._running = 0  # config that the running conversion uses
        self._begun_ns = 0
        self._part_ns = 0
        self._looked = 0
        self._sum_V = 0.0
        self._beyond = 0  # successive conversions beyond the thresholds

    # ------------------------------------------------------------------ wire face

    def acknowledges(self) -> bool:
        return not self.nack_address

    def write(self, data: bytes, t_ns: int) -> int:
        if self.nack_data:
            return 0
        self.advance_to(t_ns)
        if data:
            self._pointer = data[0] & 0x3
        if len(data) >= 3:
            self._write_register(self._pointer, data[1] << 8 | data[2], t_ns)
        return len(data)

    def read(self, n: int, t_ns: int) -> bytes:
        self.advance_to(t_ns)
        value = self.registers[self._pointer]
        if self._pointer == CONFIG:
            value = value & ~OS_BIT | (0 if self._due_ns is not None and not self.always_ready else OS_BIT)
        if self._pointer == CONVERSION and self._latching:
            self.alert_asserted = False
        return (value.to_bytes(2, "big") * (n // 2 + 1))[:n]

    def general_call(self, data: bytes, t_ns: int) -> bool:
        """Answer a call to address 0: 06h resets and powers down (Reset and Power-Up)."""
        if data[:1] == bytes((RESET_COMMAND,)):
            self._reset()
        return not self.nack_address

    def next_event_ns(self) -> int | None:
        return None if self.frozen else self._look_ns()

    def advance_to(self, t_ns: int) -> None:
        while (due_ns := self._look_ns()) is not None and due_ns <= t_ns and not self.frozen:
            if due_ns == self._due_ns:
                self._finish(due_ns)
            else:
                self._looked += 1
                self._sum_V += self._differential_V(due_ns)

    # ------------------------------------------------------------------ conversions

    @property
    def _latching(self) -> bool:
        return bool(self.registers[CONFIG] & 0x4)

    def _write_register(self, pointer: int, value: int, t_ns: int) -> None:
        if pointer == CONVERSION:
            return  # read only
        self.registers[pointer] = value
        if pointer != CONFIG or self.frozen:
            return
        single_shot = bool(value & MODE_BIT)
        if self._due_ns is None and (not single_shot or value & OS_BIT):
            self._begin(t_ns, WAKE_UP_NS)

    def _begin(self, t_ns: int, delay_ns: int) -> None:
        self._running = self.registers[CONFIG]
        rate_hz = RATES_HZ[self._running >> 5 & 0x7] * (1.0 + self._rate_error)
        self._sum_V = 0.5 * self._differential_V(t_ns)
        self._begun_ns = t_ns + delay_ns
        self._part_ns = round(1e9 / rate_hz) // self._looks
        self._due_ns = self._begun_ns + round(1e9 / rate_hz)
        self._looked = 1

    def _look_ns(self) -> int | None:
        """Return the time at which the input is sampled next; the last sample is at the end of the conversion."""
        if self._due_ns is None or self._looked >= self._looks:
            return self._due_ns
        return self._begun_ns + self._looked * self._part_ns

    def _differential_V(self, t_ns: int) -> float:
        volts = self._inputs(t_ns)
        positive, negative = MUX[self._running >> 12 & 0x7]
        return float(volts[positive]) - (0.0 if negative is None else float(volts[negative]))

    def _finish(self, t_ns: int) -> None:
        mean_V = (self._sum_V + 0.5 * self._differential_V(t_ns)) / self._looks
        full_scale_V = FULL_SCALE_V[self._running >> 9 & 0x7]
        code = int(np.clip(np.rint(mean_V * 32768.0 / full_scale_V), -32768, 32767))
        self.registers[CONVERSION] = code & 0xFFFF
        self.conversions += 1
        self._compare(code)
        self._due_ns = None
        if not self.registers[CONFIG] & MODE_BIT:
            self._begin(t_ns, 0)

    def _compare(self, code: int) -> None:
        """Update the comparator with queue, window mode and latch; Hi < 0 <= Lo MSBs make it a conversion-ready
        signal."""
        config = self.registers[CONFIG]
        queue = config & 0x3
        if queue == 3:
            self.alert_asserted = False
            return
        lo, hi = _signed(self.registers[LO_THRESH]), _signed(self.registers[HI_THRESH])
        if hi < 0 <= lo:
            self.alert_asserted = True
            return
        window = bool(config & 0x10)
        beyond = code > hi or (window and code < lo)
        self._beyond = self._beyond + 1 if beyond else 0
        if self._beyond >= (1, 2, 4)[queue]:
            self.alert_asserted = True
        elif not beyond and not self._latching and (window or code < lo):
            self.alert_asserted = False


def _signed(value: int) -> int:
    return value - 0x10000 if value & 0x8000 else value
