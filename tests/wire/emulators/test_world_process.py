"""The world as a process, over real ptys, sockets and multicast; asserts on counts and content, not on speed."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hal.backends import open_can, open_i2c, open_serial
from hal.bench import load_bench
from hal.errors import BenchError, Disconnected, I2cNack
from hal.types import CanFrame, I2cRead, I2cWrite
from sim_devices.process_world import ProcessWorld
from sim_devices.register import provider

pytestmark = pytest.mark.realtime
BENCH = Path(__file__).parents[3] / "benches" / "micron.toml"
FAKE = "tests.wire.emulators.fake_plant:make_fake"


def start(folder: Path, **changes: Any) -> ProcessWorld:
    table = load_bench(BENCH).description.model_dump()
    for key, value in changes.items():
        table["device"][key] = value
    return ProcessWorld(table, folder, None, None, FAKE)


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ProcessWorld]:
    world = start(tmp_path_factory.mktemp("world"))
    yield world
    world.stop()


def read_until(port: Any, end: bytes, timeout_s: float = 5.0) -> bytes:
    got, buffer = b"", memoryview(bytearray(65536))
    deadline = time.monotonic() + timeout_s
    while not got.endswith(end) and time.monotonic() < deadline:
        got += bytes(buffer[: port.read_into(buffer, 0.2)])
    return got


def configured_daq(world: ProcessWorld) -> Any:
    port = open_serial(world.endpoint("daq0"))
    port.write(b"stop\r", 1.0)
    read_until(port, b"stop\r")
    for text in (b"info 1", b"srate 60000", b"dec 1", *(b"slist %d %d" % (i, 256 + i) for i in range(8))):
        port.write(text + b"\r", 1.0)
        assert read_until(port, b"\r").startswith(text)
    return port


def test_daq_over_pyserial_counts_every_scan(world: ProcessWorld) -> None:
    port = configured_daq(world)
    port.write(b"start 0\r", 1.0)
    data, buffer = b"", memoryview(bytearray(65536))
    while len(data) < 300 * 16:
        n = port.read_into(buffer, 2.0)
        assert n > 0
        data += bytes(buffer[:n])
    port.write(b"stop\r", 1.0)
    data += read_until(port, b"stop\r")
    scans = np.frombuffer(data[: len(data) - 5], "<i2").reshape(-1, 8)
    # input 0 is a ramp of 1 V/s sampled on the device clock: 1 ms is 6.55 counts whatever the host does
    steps = np.diff(scans[:, 0].astype(float)) * 5.0 / 32768 * 1000
    assert np.median(steps) == pytest.approx(1.0, abs=0.1)
    assert np.count_nonzero(np.abs(steps - 1.0) > 0.2) <= 1  # the ramp starts again every 5 s
    port.close()


def test_i2c_over_the_socket(world: ProcessWorld) -> None:
    slow = open_i2c(world.endpoint("i2c1"))
    assert slow.transfer(0x48, [I2cWrite(b"\x01"), I2cRead(2)]) == b"\x85\x83"
    slow.close()
    bus = open_i2c(world.endpoint("i2c0"))
    bus.transfer(0x0C, [I2cWrite(b"\x31\x40\x00")])
    assert bus.transfer(0x0C, [I2cWrite(b"\x01"), I2cRead(2)]) == b"\x40\x00"
    started = time.monotonic()
    for _ in range(20):
        bus.transfer(0x0C, [I2cWrite(b"\x00\x00\x00") for _ in range(4)])
    assert time.monotonic() - started >= 20 * 149 * 2.5e-6  # bus time is a lower bound
    world.inject("nack", "piezo")
    with pytest.raises(I2cNack):
        bus.transfer(0x0C, [I2cRead(2)])
    world.inject("ack", "piezo")
    assert len(bus.transfer(0x0C, [I2cRead(2)])) == 2
    bus.close()


def test_a_busy_bus_beside_the_scans_keeps_both_whole(world: ProcessWorld) -> None:
    port = configured_daq(world)
    port.write(b"start 0\r", 1.0)
    bus = open_i2c(world.endpoint("i2c1"))
    data, buffer = b"", memoryview(bytearray(65536))
    while len(data) < 500 * 16:
        assert bus.transfer(0x48, [I2cWrite(b"\x01"), I2cRead(2)]) == b"\x85\x83"
        data += bytes(buffer[: port.read_into(buffer, 0.0)])
    port.write(b"stop\r", 1.0)
    data += read_until(port, b"stop\r")
    scans = np.frombuffer(data[: len(data) - 5], "<i2").reshape(-1, 8)
    steps = np.diff(scans[:, 0].astype(float)) * 5.0 / 32768 * 1000
    assert np.count_nonzero(np.abs(steps - 1.0) > 0.2) <= 1  # the ramp starts again every 5 s
    bus.close()
    port.close()


def test_can_over_a_socket_carries_the_stop_button(world: ProcessWorld) -> None:
    bus = open_can(world.endpoint("can0"))
    bus.send(CanFrame(0x200, bytes(8)), 1.0)
    world.inject("press")
    deadline = time.monotonic() + 5.0
    pressed = False
    while not pressed and time.monotonic() < deadline:
        frame = bus.recv(0.5)
        pressed = frame is not None and frame.can_id == 0x080 and frame.data[0] == 1
    world.inject("release")
    bus.close()
    assert pressed


def test_unknown_fault_is_refused(world: ProcessWorld) -> None:
    with pytest.raises(ValueError, match="faults are"):
        world.inject("melt", "daq")


def test_unplug_stop_and_truth(tmp_path: Path) -> None:
    world = start(tmp_path)
    port = open_serial(world.endpoint("daq0"))
    assert world.alive()
    world.inject("unplug", "daq")
    with pytest.raises(Disconnected):
        read_until(port, b"never", 2.0)
    port.close()
    before_ns = time.monotonic_ns()
    world.stop()
    world.stop()
    assert not world.alive()
    truth = world.truth()
    assert abs(int(truth["t_ns"][-1]) - before_ns) < 2 * 10**9  # on the bench clock
    assert "worst_late_us" in world.statistics()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_to_a_whole_run_leaves_the_devices_to_the_firmware(tmp_path: Path, number: signal.Signals) -> None:
    """``timeout`` and systemd send SIGTERM to every process of a run, and a device answers until the run is over."""
    world = start(tmp_path)
    assert os.getsid(world.pid) == world.pid
    bus = open_i2c(world.endpoint("i2c1"))
    os.kill(world.pid, number)
    for _ in range(3):  # the second one is read in a turn that began after the signal
        assert bus.transfer(0x48, [I2cWrite(b"\x01"), I2cRead(2)]) == b"\x85\x83"
    bus.close()
    world.stop()
    assert not world.alive()
    assert len(world.truth()["t_ns"]) > 0


def test_killed_world_hangs_up_and_says_that_truth_is_lost(tmp_path: Path) -> None:
    world = start(tmp_path)
    port = open_serial(world.endpoint("daq0"))
    os.kill(world.pid, signal.SIGKILL)
    with pytest.raises(Disconnected):
        read_until(port, b"never", 5.0)
    port.close()
    world.stop()
    with pytest.raises(Disconnected, match="killed"):
        world.truth()
    with pytest.raises(Disconnected):
        world.inject("press")


def test_a_world_that_cannot_start_says_why(tmp_path: Path) -> None:
    with pytest.raises(BenchError, match="hydraulic"):
        start(tmp_path, piezo={"driver": "hydraulic", "bus": "i2c0", "address": 12})


def test_a_hand_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    table = load_bench(BENCH).description.model_dump()
    with pytest.raises(BenchError, match=r"nobody\.csv"):
        provider(table, clock=None, runtime_dir=tmp_path, hand_file=tmp_path / "nobody.csv", hand_scale=None)


def test_can_as_a_serial_adapter_on_a_pty(tmp_path: Path) -> None:
    table = load_bench(BENCH).description.model_dump()
    table["bus"]["can0"]["uri"] = "sim://can0?via=slcan"
    world = ProcessWorld(table, tmp_path, None, None, FAKE)
    bus = open_can(world.endpoint("can0"))
    bus.send(CanFrame(0x201, bytes(8)), 1.0)
    frame = bus.recv(5.0)
    assert frame is not None
    assert (frame.can_id, frame.data[0]) == (0x080, 0)
    bus.close()
    world.stop()
