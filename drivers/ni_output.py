"""Implements AnalogOutput over NI-DAQmx: one output channel per stack, in front of an amplifier of fixed gain.

Software-timed: one sample per tick, on demand. The readback uses the internal channels ``_aoN_vs_aognd`` that
multifunction devices have, so it measures what the converter really gives.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from drivers.output_guard import GuardedOutput, OutputGuard
from hal.arrays import Array
from hal.backends import nidaqmx_package
from hal.contracts import Clock
from hal.errors import BenchError
from hal.types import OutputLimit

WRITE_TIMEOUT_S = 0.01
READ_TIMEOUT_S = 0.5
TOLERANCE_V = 0.02  # at the converter


class NidaqmxOutput(GuardedOutput):
    """Drives outputs ``ao0`` ... of ``device``. All values are volts behind the amplifier (``gain``)."""

    def __init__(
        self,
        device: str,
        clock: Clock,
        channels: Sequence[int] = (0, 1, 2),
        *,
        gain: float = 20.0,
        lo_V: float = 0.0,
        hi_V: float = 100.0,
        neutral_V: float = 50.0,
        slew_V_per_s: float = 20_000.0,
        name: str = "piezo",
    ) -> None:
        if not lo_V <= neutral_V <= hi_V or max(abs(lo_V), abs(hi_V)) / gain > 10.0:
            raise BenchError(
                f"lo_V = {lo_V}, neutral_V = {neutral_V}, hi_V = {hi_V}: they must rise"
                f" and lie within +-{10 * gain:g} V (gain {gain:g})",
                device=name,
            )
        self.name = name
        self.limits = (OutputLimit(lo_V, hi_V, slew_V_per_s, neutral_V),) * len(channels)
        self.guard = OutputGuard(name, self.limits, clock)
        self._clock = clock
        self._device, self._highest = device, max(channels)
        self._gain = gain
        self._nidaqmx = nidaqmx_package.load()
        self._data = np.zeros(len(channels))
        self._known = False
        self._out: Any = nidaqmx_package.new_task(self._nidaqmx, name)
        self._back: Any = nidaqmx_package.new_task(self._nidaqmx, name)
        try:
            for channel in channels:
                self._out.ao_channels.add_ao_voltage_chan(
                    f"{device}/ao{channel}", min_val=lo_V / gain, max_val=hi_V / gain
                )
                self._back.ai_channels.add_ai_voltage_chan(
                    f"{device}/_ao{channel}_vs_aognd", min_val=-10.0, max_val=10.0
                )
        except self._nidaqmx.errors.DaqError as error:
            self._out.close()
            self._back.close()
            raise nidaqmx_package.translated(error, name) from error
        self._writer: Any = self._nidaqmx.stream_writers.AnalogMultiChannelWriter(self._out.out_stream, auto_start=True)
        self._reader: Any = self._nidaqmx.stream_readers.AnalogMultiChannelReader(self._back.in_stream)

    def probe(self) -> str:
        """Return the card's product, serial number and number of outputs. Raises ``WrongDevice`` for too few
        outputs."""
        return nidaqmx_package.identify_card(self._nidaqmx, self._device, self.name, "ao", highest=self._highest)

    def arming(self) -> Iterator[None]:
        """Ramp to neutral and compare the measured voltages with it."""
        self._known = False
        while not self.safe_step():
            yield
        measured_V = self.readback_V() / self._gain
        wanted = np.array([limit.safe_V for limit in self.limits]) / self._gain
        self.guard.require(
            bool(np.abs(measured_V - wanted).max() <= TOLERANCE_V),
            f"neutral is {wanted.tolist()} V at the converter, read back {measured_V.round(3).tolist()} V",
        )
        self.guard.armed = True

    def write(self, values_V: Array) -> int:
        """Write ``values_V`` (channels,) and return the mask, both as ``AnalogOutput.write`` says."""
        mask = self.guard.admit(values_V)
        self._send()
        return mask

    def safe_step(self) -> bool:
        if not self._known:
            self.guard.start_from([float(v) for v in self.readback_V()])
            self._known = True
        done = self.guard.ramp()
        self._send()
        return done

    def readback_V(self) -> Array:
        data = np.zeros(len(self.limits))
        try:
            self._reader.read_one_sample(data, READ_TIMEOUT_S)
        except self._nidaqmx.errors.DaqError as error:
            raise nidaqmx_package.translated(error, self.name) from error
        return data * self._gain

    def close(self) -> None:
        if self._out is None:
            return
        try:
            if self._known:
                self.ramp_to_neutral()
        finally:
            self._out.close()
            self._back.close()
            self._out = None

    def _send(self) -> None:
        self._data[:] = self.guard.next_V
        self._data /= self._gain
        try:
            self._writer.write_one_sample(self._data, WRITE_TIMEOUT_S)
        except self._nidaqmx.errors.DaqError as error:
            raise nidaqmx_package.translated(error, self.name) from error
        self.guard.sent()
