"""What a test puts in the place of the physics, and orders to a world, in virtual time and over the wire."""

from __future__ import annotations

import json
import socket
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hal.clock import VirtualClock
from hal.types import I2cRead, I2cWrite
from sim_devices.control import WorldControl
from sim_devices.lockstep_world import LockstepWorld
from sim_devices.process import PausableClock
from sim_devices.register import provider
from sim_devices.stimuli import UnknownChannel, constant, played
from sim_devices.transports.control_socket import ControlSocket

S = 1_000_000_000
TURNED = {"imu": {"errors": 0.0, "noise": 0.0, "position_mm": [0.0, 80.0, 0.0], "turn_deg": [0.0, 0.0, 90.0]}}


def world_of(**device: Any) -> tuple[LockstepWorld, VirtualClock]:
    """A resting body with one part on ``bus0``."""
    kind = "serial" if device["driver"] in ("di4108", "e727") else "i2c"
    table = {
        "format": 1,
        "name": "one",
        "emulation": {"endoscope": {"scenario": "hand"}, "imu": TURNED if "imu" in device["name"] else {}},
        "bus": {"bus0": {"kind": kind, "uri": "sim://bus0"}},
        "device": {device.pop("name"): {"bus": "bus0", **device}},
    }
    clock = VirtualClock()
    world = provider(table, clock=clock, runtime_dir=Path("unused"), hand_file=None, hand_scale=None)
    assert isinstance(world, LockstepWorld)
    return world, clock


def order(world: LockstepWorld, clock: VirtualClock, **what: Any) -> dict[str, Any]:
    control = WorldControl(world.world, world.inject, clock.now_ns)
    return json.loads(control.answer(json.dumps(what).encode()))


def read_accelerometer(world: LockstepWorld) -> list[float]:
    bus: Any = world.endpoint("bus0")
    counts = np.frombuffer(bus.transfer(0x68, [I2cWrite(b"\x3b"), I2cRead(14)]), ">i2")
    return [*(counts[:3] / 16384.0 * 9.80665), *np.radians(counts[4:] / 131.0)]


def test_a_stimulus_is_felt_along_the_axes_of_the_sensor() -> None:
    """The chip is turned and off centre on a body that is moved; what is put is what it feels, without a lever arm."""
    world, clock = world_of(name="imu", driver="mpu6050", address=0x68)
    bus: Any = world.endpoint("bus0")
    bus.transfer(0x68, [I2cWrite(b"\x6b\x00")])
    put = {"imu.ax": 1.0, "imu.ay": -2.0, "imu.az": 3.0, "imu.gx": 0.5, "imu.gy": -1.0, "imu.gz": 0.25}
    assert order(world, clock, set=put)["ok"]
    clock.advance_to(2 * S)
    assert read_accelerometer(world) == pytest.approx([*put.values()], abs=0.01)
    assert order(world, clock, get="imu.az")["values"] == {"imu.az": 3.0}
    assert order(world, clock, set=dict.fromkeys(put))["ok"]
    clock.advance_to(3 * S)
    physics = list(order(world, clock, get="imu")["values"].values())
    assert physics[:6] != [*put.values()]
    assert read_accelerometer(world)[:3] == pytest.approx(physics[:3], abs=0.5)  # of 11 m/s^2, behind its filter


def test_a_column_is_played_into_the_daq() -> None:
    world, clock = world_of(name="daq", driver="di4108")
    port: Any = world.endpoint("bus0")
    port.write(b"slist 0 0\r" + b"srate 60000\r" + b"dec 1\r", 1.0)
    port.drain_input()
    t_s = np.arange(0.0, 1.0, 0.1)
    assert order(world, clock, play="daq.0", t_s=list(t_s), values=list(10.0 * t_s))["ok"]
    port.write(b"start 0\r", 1.0)
    clock.advance_to(1_500_000_000)
    data, buffer = b"", memoryview(bytearray(65536))
    while n := port.read_into(buffer, 0.0):
        data += bytes(buffer[:n])
    assert len(data) == 2 * 1024 + len(b"stop 01")  # nobody read: the FIFO is full, and the device says so
    volts = np.frombuffer(data[:2048], "<i2") * 10.0 / 32768
    assert volts == pytest.approx(np.minimum(10.0 * np.arange(1, 1025) * 1e-3, 9.0), abs=2e-3)


def test_outputs_are_read_and_not_set() -> None:
    world, clock = world_of(name="dac", driver="dac_amplifier", address=0x0C)
    bus: Any = world.endpoint("bus0")
    bus.transfer(0x0C, [I2cWrite(b"\x31\x40\x00")])
    assert order(world, clock, get="dac")["values"]["dac.out0"] == pytest.approx(1.25, abs=0.01)
    refused = order(world, clock, set={"dac.out0": 1.0})
    assert not refused["ok"]
    assert "output" in refused["error"]


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ({"set": {"daq.8": 1.0}}, "daq.0"),
        ({"set": {"daq.0": float("nan")}}, "finite"),
        ({"set": {"daq.0": "high"}}, "daq.0: 'high' is not a number"),
        ({"set": 3}, "set takes an object"),
        ({"get": "nobody"}, "no channel"),
        ({"play": "daq.0", "t_s": [0, 0], "values": [1, 2]}, "rise"),
        ({"play": "daq.0", "t_s": [0]}, "values"),
        ({"play": "daq.0", "file": "nowhere.npz"}, "nowhere.npz"),
        ({"fault": "melt", "target": "daq"}, "melt"),
        ({"pause": True}, "driven by the program"),
        ({"hello": 1}, "an order has one of"),
    ],
)
def test_an_order_that_cannot_be_done_says_why_and_changes_nothing(what: dict[str, Any], said: str) -> None:
    world, clock = world_of(name="daq", driver="di4108")
    before = order(world, clock, get="daq")
    answer = order(world, clock, **what)
    assert not answer["ok"]
    assert said in answer["error"]
    assert order(world, clock, get="daq") == before


def test_half_of_what_is_set_together_is_not_set() -> None:
    world, clock = world_of(name="daq", driver="di4108")
    assert not order(world, clock, set={"daq.0": 5.0, "daq.9": 1.0})["ok"]
    assert order(world, clock, get="daq.0")["values"]["daq.0"] == 0.0


def test_list_names_channels_parts_and_faults() -> None:
    world, clock = world_of(name="piezo", driver="e727")
    told = order(world, clock, list=True)
    assert told["channels"]["piezo.position1"] == "um"
    assert told["parts"] == ["piezo"]
    assert any(line.startswith("freeze") for line in told["faults"])
    assert "stroke_m" in order(world, clock, truth=True)["truth"]


def test_a_column_runs_on_straight_lines_and_stays_at_its_ends() -> None:
    source = played([0.0, 1.0], [2.0, 4.0], S)
    assert [source(t) for t in (0, S, 3 * S // 2, 5 * S)] == [2.0, 2.0, 3.0, 4.0]
    assert constant(3.0)(7) == 3.0
    with pytest.raises(UnknownChannel, match="one length"):
        played([0.0, 1.0], [2.0], 0)


def test_a_clock_that_is_paused_goes_on_where_it_stood() -> None:
    clock = PausableClock()
    clock.pause()
    stood = clock.now_ns()
    assert clock.now_ns() == stood
    clock.advance(0.5)
    assert clock.now_ns() == stood + S // 2
    clock.resume()
    assert clock.now_ns() >= stood + S // 2
    with pytest.raises(ValueError, match="after it was paused"):
        clock.advance(0.5)


def test_the_control_socket_answers_line_by_line_and_cuts_off_who_floods_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sim_devices.transports.control_socket.MAX_LINE", 1000)
    server = ControlSocket(tmp_path / "control.sock", lambda line: line.upper())
    with socket.socket(socket.AF_UNIX) as client:
        client.connect(str(tmp_path / "control.sock"))
        client.sendall(b"one\ntw")
        for _ in range(3):
            server.pump()
        assert client.recv(100) == b"ONE\n"
        client.sendall(b"o\n\nthree\n")
        server.pump()
        assert client.recv(100) == b"TWO\nTHREE\n"
        client.sendall(b"x" * 2000)
        server.pump()
        assert client.recv(100) == b""
    server.close()
    assert not (tmp_path / "control.sock").exists()
