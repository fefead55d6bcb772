"""Emulates the Analog Devices AD5696R: quad 16-bit DAC on I2C with a 2.5 V reference.

Source: AD5696R/AD5695R/AD5694R data sheet, rev. B: Serial Interface, Table 7 (commands), Table 8 (address bits),
Write Operation, Read Operation, Multiple DAC Readback Sequence, Power-Down Operation, LDAC Mask Register,
Internal Reference Setup. Wire face: I2C segments. Truth face: ``output_V`` and the ``on_output`` callback.

Model limits
- Output settling (5 us), slew, integral and differential non-linearity, load and reference drift are left out:
  an output steps to its ideal value on the acknowledge of the third byte.
- Bytes of a write segment beyond the third start the next 24-bit word; the data sheet shows one word per
  segment and is silent on longer ones. An incomplete word does nothing but set the readback pointer.
- A powered-down channel shows 0 V for every one of the three pull-down modes.
- With the internal reference off and no external one, outputs are 0 V.
- Power-up time, the RESET pin and glitch energy are not modelled; the LDAC pin is strapped (``ldac_low``).
- The part has no general call (Serial Interface), so address 0 is not answered.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

REFERENCE_V = 2.5
CHANNELS = 4
SELECTED = tuple(tuple(c for c in range(CHANNELS) if bits >> c & 1) for bits in range(16))  # Table 8


class Ad5696r:
    """Emulates one AD5696R. ``gain`` is 2 with the GAIN pin at VDD (0..5 V); ``midscale`` is the RSTSEL strap.

    ``on_output(channel, volts, t_ns)`` is called whenever an output changes.
    """

    def __init__(
        self,
        *,
        gain: int = 2,
        midscale: bool = True,
        ldac_low: bool = False,
        on_output: Callable[[int, float, int], None] | None = None,
    ) -> None:
        self.nack_address = False
        self.nack_data = False
        self.frozen = False
        self.output_V = [0.0] * CHANNELS
        self._full_scale_V = REFERENCE_V * gain
        self._reset_code = 0x8000 if midscale else 0
        self._ldac_low = ldac_low
        self._on_output = on_output
        self._reset()
        for channel in range(CHANNELS):
            self.output_V[channel] = self._volts(channel)

    def _reset(self) -> None:
        self.input_codes = [self._reset_code] * CHANNELS
        self.dac_codes = [self._reset_code] * CHANNELS
        self.power_down = [0] * CHANNELS
        self.ldac_mask = 0
        self.reference_on = True
        self._pointer = 0

    def brown_out(self, t_ns: int) -> None:
        """Restart the part with its power-up outputs, as after a dip of the supply (fault hook)."""
        self._reset()
        for channel in range(CHANNELS):
            self._drive(channel, t_ns)

    def acknowledges(self) -> bool:
        return not self.nack_address

    def advance_to(self, t_ns: int) -> None:
        """Do nothing: the part does not act by itself."""

    def next_event_ns(self) -> int | None:
        return None

    def write(self, data: bytes, t_ns: int) -> int:
        """Accept 24-bit words: command and address nibble, high byte, low byte."""
        n = len(data)
        if self.nack_data:
            return 0
        for i in range(0, n, 3):
            first = data[i]
            self._pointer = first & 0xF
            if i + 3 <= n and not self.frozen:
                self._execute(first >> 4, first & 0xF, data[i + 1] << 8 | data[i + 2], t_ns)
        return n

    def read(self, n: int, t_ns: int) -> bytes:
        """Input registers from the addressed channel on (A when several are), wrapping after D."""
        selected = SELECTED[self._pointer]
        channel = selected[0] if len(selected) == 1 else 0
        out = bytearray()
        while len(out) < n:
            out += self.input_codes[channel].to_bytes(2, "big")
            channel = (channel + 1) % CHANNELS
        return bytes(out[:n])

    def general_call(self, data: bytes, t_ns: int) -> bool:
        return False

    def _execute(self, command: int, address: int, value: int, t_ns: int) -> None:
        if command in (1, 3):
            for channel in SELECTED[address]:
                self.input_codes[channel] = value
        if command == 1:
            if self._ldac_low:
                self._update([c for c in SELECTED[address] if not self.ldac_mask >> c & 1], t_ns)
            return
        if command in (2, 3):
            self._update(SELECTED[address], t_ns)
            return
        if command == 4:
            self.power_down = [value >> 2 * c & 0x3 for c in range(CHANNELS)]
        elif command == 5:
            self.ldac_mask = value & 0xF
        elif command == 6:
            self._reset()
        elif command == 7:
            self.reference_on = not value & 1
        for channel in range(CHANNELS):
            self._drive(channel, t_ns)

    def _update(self, channels: Sequence[int], t_ns: int) -> None:
        for channel in channels:
            code = self.input_codes[channel]
            if code != self.dac_codes[channel]:
                self.dac_codes[channel] = code
                self._drive(channel, t_ns)

    def _volts(self, channel: int) -> float:
        if self.power_down[channel] or not self.reference_on:
            return 0.0
        return self._full_scale_V * self.dac_codes[channel] / 65536

    def _drive(self, channel: int, t_ns: int) -> None:
        volts = self._volts(channel)
        if volts != self.output_V[channel]:
            self.output_V[channel] = volts
            if self._on_output is not None:
                self._on_output(channel, volts, t_ns)
