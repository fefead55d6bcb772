"""NI backends against the interface of the installed nidaqmx package (autospec): a call it does not know fails."""

from __future__ import annotations

import sys
from typing import Any
from unittest.mock import MagicMock, PropertyMock, create_autospec

import nidaqmx
import nidaqmx.errors
import nidaqmx.stream_readers
import nidaqmx.stream_writers
import nidaqmx.system
import nidaqmx.task.collections
import numpy as np
import pytest
from nidaqmx.constants import AcquisitionType, OverwriteMode, TerminalConfiguration
from nidaqmx.task import InStream, OutStream, Task, Timing

from drivers.ni_output import NidaqmxOutput
from drivers.output_guard import RAMP_STEPS
from hal.backends.nidaqmx_ai import NidaqmxScan
from hal.clock import VirtualClock
from hal.errors import BenchError, BusError, DeviceNotFound, Disconnected, HalError, Overrun, SafetyTrip, WrongDevice
from hal.types import ScanConfig, Status

MS = 1_000_000
DEVICE = nidaqmx.system.Device


class Package:
    """nidaqmx with every task, stream, reader and writer replaced by its autospec."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.tasks: list[MagicMock] = []
        self.reader = create_autospec(nidaqmx.stream_readers.AnalogMultiChannelReader, instance=True)
        self.writer = create_autospec(nidaqmx.stream_writers.AnalogMultiChannelWriter, instance=True)
        self.available = 0
        monkeypatch.setattr(nidaqmx, "Task", self.new_task)
        monkeypatch.setattr(nidaqmx.stream_readers, "AnalogMultiChannelReader", lambda stream: self.reader)
        monkeypatch.setattr(nidaqmx.stream_writers, "AnalogMultiChannelWriter", lambda stream, auto_start: self.writer)

    def new_task(self) -> MagicMock:
        task = create_autospec(Task, instance=True)
        task.ai_channels = create_autospec(nidaqmx.task.collections.AIChannelCollection, instance=True)
        task.ao_channels = create_autospec(nidaqmx.task.collections.AOChannelCollection, instance=True)
        task.do_channels = create_autospec(nidaqmx.task.collections.DOChannelCollection, instance=True)
        task.timing = create_autospec(Timing, instance=True)
        task.timing.samp_clk_rate = 1000.0
        task.in_stream = create_autospec(InStream, instance=True)
        type(task.in_stream).avail_samp_per_chan = PropertyMock(side_effect=lambda: self.available)
        task.out_stream = create_autospec(OutStream, instance=True)
        self.tasks.append(task)
        return task


@pytest.fixture
def package(monkeypatch: pytest.MonkeyPatch) -> Package:
    return Package(monkeypatch)


@pytest.fixture
def scan(package: Package) -> tuple[NidaqmxScan, VirtualClock]:
    clock = VirtualClock()
    device = NidaqmxScan("Dev1", clock)
    device.configure(ScanConfig(1000.0, (0, 5), (5.0, 10.0)))
    device.start()
    return device, clock


def daq_error(code: int) -> nidaqmx.errors.DaqError:
    return nidaqmx.errors.DaqError("it went wrong", code, "task")


def test_configure_asks_for_what_the_bench_says(package: Package):
    device = NidaqmxScan("Dev1", VirtualClock())
    info = device.configure(ScanConfig(1000.0, (0, 5), (5.0, 10.0)))
    task = package.tasks[0]
    calls = [c.args + tuple(c.kwargs.values()) for c in task.ai_channels.add_ai_voltage_chan.call_args_list]
    assert calls == [
        ("Dev1/ai0", TerminalConfiguration.RSE, -5.0, 5.0),
        ("Dev1/ai5", TerminalConfiguration.RSE, -10.0, 10.0),
    ]
    task.timing.cfg_samp_clk_timing.assert_called_once_with(
        1000.0, sample_mode=AcquisitionType.CONTINUOUS, samps_per_chan=1000
    )
    assert task.in_stream.overwrite is OverwriteMode.DO_NOT_OVERWRITE_UNREAD_SAMPLES
    assert info.lsb_V == (5.0 / 32768, 10.0 / 32768)
    assert info.buffer_scans == 1000
    device.start()
    task.start.assert_called_once_with()
    device.stop()
    task.stop.assert_called_once_with()
    device.close()
    device.close()
    task.close.assert_called_once_with()


def fill(values: list[list[float]]) -> Any:
    def read(data: np.ndarray, number_of_samples_per_channel: int, timeout: float) -> int:
        assert data.flags.c_contiguous
        assert data.shape == (2, number_of_samples_per_channel)
        data[:] = np.array(values).T[:, :number_of_samples_per_channel]
        return number_of_samples_per_channel

    return read


def test_volts_become_counts_of_the_declared_step(package: Package, scan: tuple[NidaqmxScan, VirtualClock]):
    device, clock = scan
    package.available = 2
    package.reader.read_many_sample.side_effect = fill([[1.25, -2.5], [-5.0, 5.0]])
    clock.burn_ns(20 * MS)
    out = np.zeros((8, 2), dtype=np.int16)
    block = device.read_scans(out, 0.01)
    assert out[:2].tolist() == [[8192, -8192], [-32768, 16384]]
    assert (block.n, block.seq0, block.t0_ns, block.dt_ns) == (2, 0, 19 * MS, MS)
    assert block.status is Status.SATURATED  # -5 V of +-5 V


def test_never_asks_for_more_than_fits(package: Package, scan: tuple[NidaqmxScan, VirtualClock]):
    package.available = 500
    package.reader.read_many_sample.side_effect = fill([[0.0, 0.0]] * 3)
    assert scan[0].read_scans(np.zeros((3, 2), dtype=np.int16), 0.01).n == 3


def test_not_yet_available_is_a_timeout(package: Package, scan: tuple[NidaqmxScan, VirtualClock]):
    package.reader.read_many_sample.side_effect = daq_error(-200284)
    assert scan[0].read_scans(np.zeros((3, 2), dtype=np.int16), 0.01).n == 0


@pytest.mark.parametrize(
    ("code", "error_class"),
    [(-200279, Overrun), (-200222, Overrun), (-201003, Disconnected), (-200220, BenchError), (-1, BusError)],
)
def test_daq_errors_keep_their_cause(
    package: Package, scan: tuple[NidaqmxScan, VirtualClock], code: int, error_class: type[HalError]
):
    package.reader.read_many_sample.side_effect = daq_error(code)
    with pytest.raises(error_class, match="it went wrong") as caught:
        scan[0].read_scans(np.zeros((3, 2), dtype=np.int16), 0.01)
    assert isinstance(caught.value.__cause__, nidaqmx.errors.DaqError)


def test_switch_outputs(package: Package, scan: tuple[NidaqmxScan, VirtualClock]):
    scan[0].write_digital(2)
    digital = package.tasks[1]
    digital.do_channels.add_do_chan.assert_called_once_with("Dev1/port0/line0:1")
    digital.write.assert_called_once_with([False, True], auto_start=True)
    with pytest.raises(BenchError):
        scan[0].write_digital(4)


def output(package: Package, at_V: float = 2.5) -> tuple[NidaqmxOutput, VirtualClock]:
    clock = VirtualClock()

    def read(data: np.ndarray, timeout: float) -> None:
        data[:] = at_V

    package.reader.read_one_sample.side_effect = read
    return NidaqmxOutput("Dev1", clock, slew_V_per_s=1e9), clock


def written(package: Package) -> list[list[float]]:
    return [c.args[0].tolist() for c in package.writer.write_one_sample.call_args_list]


def test_output_channels_and_their_internal_readback(package: Package):
    output(package)
    out, back = package.tasks
    assert [c.args[0] for c in out.ao_channels.add_ao_voltage_chan.call_args_list] == [
        "Dev1/ao0",
        "Dev1/ao1",
        "Dev1/ao2",
    ]
    assert out.ao_channels.add_ao_voltage_chan.call_args_list[0].kwargs == {"min_val": 0.0, "max_val": 5.0}
    assert [c.args[0] for c in back.ai_channels.add_ai_voltage_chan.call_args_list] == [
        "Dev1/_ao0_vs_aognd",
        "Dev1/_ao1_vs_aognd",
        "Dev1/_ao2_vs_aognd",
    ]


def test_output_divides_by_the_gain_and_clips(package: Package):
    device, clock = output(package)
    sent: list[list[float]] = []
    package.writer.write_one_sample.side_effect = lambda data, timeout: sent.append(data.tolist())
    device.arm()
    clock.burn_ns(MS)
    assert device.write(np.array([20.0, 120.0, 50.0])) == 0b010
    assert sent[-1] == [1.0, 5.0, 2.5]
    assert device.readback_V().tolist() == [50.0, 50.0, 50.0]
    sent.clear()
    device.close()
    assert len(sent) == RAMP_STEPS
    assert sent[-1] == [2.5, 2.5, 2.5]
    device.close()
    for task in package.tasks:
        task.close.assert_called_once_with()


def test_output_self_test(package: Package):
    device, _ = output(package, at_V=2.4)
    with pytest.raises(SafetyTrip, match="self-test"):
        device.arm()


def card(monkeypatch: pytest.MonkeyPatch, **facts: Any) -> None:
    """Let NI's driver report one card with ``facts``, whatever its name."""
    device = create_autospec(DEVICE, instance=True, **facts)
    monkeypatch.setattr(nidaqmx.system, "Device", lambda name: device)


def test_probe_reports_what_the_driver_says_of_the_card(package: Package, monkeypatch: pytest.MonkeyPatch):
    channels = {"ai_physical_chans": range(16), "ao_physical_chans": range(4)}
    card(monkeypatch, product_type="USB-6343", serial_num=0x1B2C3D4, is_simulated=False, **channels)
    assert NidaqmxScan("Dev1", VirtualClock()).probe() == "NI USB-6343 Dev1, serial number 1B2C3D4, 16 ai channels"
    assert output(package)[0].probe() == "NI USB-6343 Dev1, serial number 1B2C3D4, 4 ao channels"
    card(monkeypatch, product_type="USB-6343", serial_num=0, is_simulated=True, **channels)
    assert NidaqmxScan("Dev1", VirtualClock()).probe().endswith("16 ai channels, simulated by NI-DAQmx")


def test_probe_refuses_a_card_with_too_few_outputs(package: Package, monkeypatch: pytest.MonkeyPatch):
    card(monkeypatch, product_type="USB-6001", serial_num=1, is_simulated=False, ao_physical_chans=range(2))
    with pytest.raises(WrongDevice, match="USB-6001 with 2 ao channels, the bench uses ao2"):
        output(package)[0].probe()


def test_probe_of_an_unknown_name_is_a_bench_error(monkeypatch: pytest.MonkeyPatch):
    device = create_autospec(DEVICE, instance=True)
    type(device).product_type = PropertyMock(side_effect=daq_error(-200220))
    monkeypatch.setattr(nidaqmx.system, "Device", lambda name: device)
    with pytest.raises(BenchError, match="no NI device of this name"):
        NidaqmxScan("Dev7", VirtualClock()).probe()


def test_output_range_is_checked():
    with pytest.raises(BenchError):
        NidaqmxOutput("Dev1", VirtualClock(), gain=5.0)


def test_absent_package_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "nidaqmx.constants", None)
    with pytest.raises(DeviceNotFound, match=r"\[ni\]"):
        NidaqmxScan("Dev1", VirtualClock())


def test_absent_driver_says_so(monkeypatch: pytest.MonkeyPatch):
    def no_driver() -> None:
        raise nidaqmx.errors.DaqNotFoundError("no driver")

    monkeypatch.setattr(nidaqmx, "Task", no_driver)
    device = NidaqmxScan("Dev1", VirtualClock())
    with pytest.raises(DeviceNotFound, match="NI-DAQmx is not installed"):
        device.configure(ScanConfig(1000.0, (0,), (5.0,)))
