"""Implements AnalogInputScan over NI-DAQmx: hardware-timed and continuous. Unread samples are never overwritten.

Scaled volts are read and given back as counts of a 16-bit converter of the same range, because each NI channel
has a calibration polynomial of its own, which ``counts * lsb_V`` could not carry.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hal.arrays import Int16Array
from hal.backends import nidaqmx_package
from hal.contracts import Clock
from hal.errors import BenchError, HalTimeout
from hal.scan_time import ScanTimeline
from hal.types import ScanBlock, ScanConfig, ScanInfo, Status, TimeSource

BUFFER_S = 1.0
MAX_SCANS = 256


class NidaqmxScan:
    """Scans inputs ``ai0`` ... of ``device`` ("Dev1"), single-ended, and drives port 0, lines 0 and 1."""

    def __init__(self, device: str, clock: Clock, *, name: str = "daq") -> None:
        self.name = name
        self.lost = 0
        self._nidaqmx = nidaqmx_package.load()
        self._device = device
        self._clock = clock
        self._task: Any = None
        self._digital: Any = None
        self._reader: Any = None
        self._stream: Any = None
        self._timeline = ScanTimeline(1e6)
        self._dt_ns = 0
        self._volts = np.empty(0)
        self._counts_per_V = np.empty(0)

    def probe(self) -> str:
        """Return the card's product, serial number and number of inputs. Raises ``BenchError`` for an unknown name."""
        return nidaqmx_package.identify_card(self._nidaqmx, self._device, self.name, "ai", highest=0)

    def configure(self, config: ScanConfig) -> ScanInfo:
        if len(config.range_V) != len(config.channels) or not config.channels:
            raise BenchError("one range per channel, and at least one channel, is needed", device=self.name)
        self.close()
        nidaqmx = self._nidaqmx
        task = self._task = nidaqmx_package.new_task(nidaqmx, self.name)
        buffer_scans = max(MAX_SCANS, round(config.rate_hz * BUFFER_S))
        try:
            for channel, range_V in zip(config.channels, config.range_V, strict=True):
                task.ai_channels.add_ai_voltage_chan(
                    f"{self._device}/ai{channel}",
                    terminal_config=nidaqmx.constants.TerminalConfiguration.RSE,
                    min_val=-range_V,
                    max_val=range_V,
                )
            task.timing.cfg_samp_clk_timing(
                config.rate_hz,
                sample_mode=nidaqmx.constants.AcquisitionType.CONTINUOUS,
                samps_per_chan=buffer_scans,
            )
            self._stream = task.in_stream
            self._stream.overwrite = nidaqmx.constants.OverwriteMode.DO_NOT_OVERWRITE_UNREAD_SAMPLES
            rate_hz = float(task.timing.samp_clk_rate)
        except nidaqmx.errors.DaqError as error:
            raise nidaqmx_package.translated(error, self.name) from error
        self._reader = nidaqmx.stream_readers.AnalogMultiChannelReader(self._stream)
        lsb_V = tuple(range_V / 32768.0 for range_V in config.range_V)
        self._counts_per_V = 1.0 / np.array(lsb_V)
        self._volts = np.empty(len(lsb_V) * MAX_SCANS)
        self._timeline = ScanTimeline(1e9 / rate_hz)
        self._timeline.warm_up()
        self._dt_ns = round(1e9 / rate_hz)
        return ScanInfo(rate_hz, tuple(config.channels), tuple(config.range_V), lsb_V, buffer_scans, simultaneous=False)

    def start(self) -> None:
        self._timeline.restart()
        self._guarded("start")

    def read_scans(self, out: Int16Array, timeout_s: float) -> ScanBlock:
        nidaqmx = self._nidaqmx
        n_channels = len(self._counts_per_V)
        try:
            n = min(max(1, int(self._stream.avail_samp_per_chan)), out.shape[0], MAX_SCANS)
            volts = self._volts[: n_channels * n].reshape(n_channels, n)
            self._reader.read_many_sample(volts, n, timeout_s)
        except nidaqmx.errors.DaqError as error:
            translated = nidaqmx_package.translated(error, self.name, self._timeline.due_by(self._clock.now_ns()))
            if isinstance(translated, HalTimeout):
                return ScanBlock(0, self._clock.now_ns(), 0, self._timeline.next_seq, TimeSource.DEVICE_CLOCK)
            raise translated from error
        counts = np.rint(volts.T * self._counts_per_V)
        saturated = bool((counts >= 32767).any() or (counts <= -32768).any())
        out[:n] = np.clip(counts, -32768, 32767)
        t0_ns, seq0, lost = self._timeline.stamp(n, self._clock.now_ns())
        self.lost += lost
        status = (Status.GAP if lost else Status.OK) | (Status.SATURATED if saturated else Status.OK)
        return ScanBlock(n, t0_ns, self._dt_ns, seq0, TimeSource.DEVICE_CLOCK, status, lost)

    def write_digital(self, bits: int) -> None:
        """Lines 0 and 1 of port 0 as switch outputs (bit 0 and 1)."""
        if not 0 <= bits <= 3:
            raise BenchError(f"digital outputs {bits:#x}: only bits 0 and 1 are outputs", device=self.name)
        nidaqmx = self._nidaqmx
        try:
            if self._digital is None:
                self._digital = nidaqmx_package.new_task(nidaqmx, self.name)
                self._digital.do_channels.add_do_chan(f"{self._device}/port0/line0:1")
            self._digital.write([bool(bits & 1), bool(bits & 2)], auto_start=True)
        except nidaqmx.errors.DaqError as error:
            raise nidaqmx_package.translated(error, self.name) from error

    def stop(self) -> None:
        if self._task is not None:
            self._guarded("stop")

    def close(self) -> None:
        for task in (self._task, self._digital):
            if task is not None:
                task.close()
        self._task = self._digital = None

    def _guarded(self, method: str) -> None:
        try:
            getattr(self._task, method)()
        except self._nidaqmx.errors.DaqError as error:
            raise nidaqmx_package.translated(error, self.name) from error
