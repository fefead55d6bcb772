"""``micron emulate`` as a stranger uses it: a process of its own, and programs that know nothing of this project."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
import serial

from hal.errors import BenchError
from sim_devices.transports import i2c_shim
from sim_devices.transports.i2c_shim import build_shim, number_buses
from tests.command import micron

HERE = Path(__file__).parent
MICRON = [sys.executable, "-m", "tools.cli.main"]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(HERE.parents[2])}
READY_S = 120.0

pytestmark = [
    pytest.mark.realtime,
    # pyserial's own, in its RFC 2217 client
    pytest.mark.filterwarnings("ignore:set(Daemon|Name):DeprecationWarning"),
]


class Emulated:
    """``micron emulate`` in an empty folder."""

    def __init__(self, folder: Path, *options: str) -> None:
        shutil.copy(HERE / "emulated.toml", folder / "bench.toml")
        (folder / "ramp.csv").write_text("t_s,volts\n0,1.5\n1000,1.5\n", encoding="utf-8")
        self.out = folder / "said"
        with self.out.open("wb") as said:
            self.process = subprocess.Popen(
                [*MICRON, "emulate", "bench.toml", "--json", "buses.json", *options],
                cwd=folder,
                env={**ENVIRONMENT, "COLUMNS": "80"},
                stdin=subprocess.DEVNULL,
                stdout=said,
                stderr=said,
                start_new_session=True,
            )
        until_s = time.monotonic() + READY_S
        while not (folder / "buses.json").exists() or "Ctrl-C" not in self.out.read_text():
            assert self.process.poll() is None, self.out.read_text()
            assert time.monotonic() < until_s, self.out.read_text()
            time.sleep(0.05)
        self.described = json.loads((folder / "buses.json").read_text())
        self.control = socket.socket(socket.AF_UNIX)
        self.control.settimeout(10.0)
        self.control.connect(self.described["control"])
        self.answers = self.control.makefile()

    def places(self, bus: str) -> list[str]:
        return self.described["buses"][bus]["places"]

    def order(self, **what: Any) -> dict[str, Any]:
        self.control.sendall(json.dumps(what).encode() + b"\n")
        return json.loads(self.answers.readline())

    def run(self, *command: str) -> str:
        """A program of somebody else, with the variables that the description names."""
        environment = {**os.environ, **self.described["environment"]}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    def close(self, number: int = signal.SIGINT) -> int:
        """End it by a signal, Ctrl-C for one; the exit status."""
        self.answers.close()
        self.control.close()
        if self.process.poll() is None:
            os.kill(self.process.pid, number) if number == signal.SIGTERM else os.killpg(self.process.pid, number)
        return self.process.wait(30)


@pytest.fixture(scope="module")
def emulated(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Emulated]:
    made = Emulated(tmp_path_factory.mktemp("stranger"), "--tcp", "0", "--stimulus", "daq.1=ramp.csv:volts")
    yield made
    made.close()


def test_the_table_fits_a_terminal_and_names_every_bus(emulated: Emulated) -> None:
    lines = emulated.out.read_text().splitlines()
    paths = (emulated.described["control"], emulated.described["environment"].get("LD_PRELOAD", "-"))
    assert all(len(line) <= 80 or any(path in line for path in paths) for line in lines)
    for bus in emulated.described["buses"].values():
        assert all(any(place in line for line in lines) for place in bus["places"])


def test_smbus2_uses_the_chips_without_knowing(emulated: Emulated) -> None:
    seen = json.loads(emulated.run(sys.executable, str(HERE / "use_i2c.py")))
    assert seen["exists"] == [True, False]
    assert seen["functions"] & 0x0FEB0001 == 0x0FEB0001 & ~0x01000000
    assert seen["who"] == 0x68
    assert seen["config"] == [0x85, 0x83]  # ADS1115, table 8-3: reset value of the config register
    assert seen["word"] == 0x8385
    assert seen["dac"] == [0x40, 0x00]
    assert seen["byte"] == 0x85
    assert seen["errors"] == {
        "absent": errno.ENXIO,
        "quick": errno.ENXIO,
        "block_read": errno.EOPNOTSUPP,
        "two_addresses": errno.EOPNOTSUPP,
    }
    assert seen["took_s"] >= 50 * (1 + 10 + 9 * 30) / 400_000  # time on the bus is a lower bound
    assert (seen["written"], seen["read"]) == (1, [0x85, 0x83])
    assert seen["no_bus"] == errno.ENOENT


def test_compiled_transfers_use_the_chips(emulated: Emulated) -> None:
    seen = json.loads(emulated.run(sys.executable, str(HERE / "use_i2c_compiled.py")))
    assert seen["read"] == ["1234", "fedc"]
    assert seen["absent"][0] == "I2cNack"
    assert "nobody acknowledges at address 0x33" in seen["absent"][1]


def test_faults_reach_a_program_as_the_kernel_s_errors(emulated: Emulated) -> None:
    program = "import smbus2, sys\ntry: smbus2.SMBus(1).write_byte(0x0C, 0x31)\nexcept OSError as e: print(e.errno)"
    for fault, target, code in (
        ("nack", "dac", errno.ENXIO),
        ("nack_data", "dac", errno.EREMOTEIO),
        ("stuck", "i2c1", errno.EIO),
    ):
        assert emulated.order(fault=fault, target=target)["ok"]
        assert emulated.run(sys.executable, "-c", program).strip() == str(int(code))
        assert emulated.order(fault={"stuck": "free"}.get(fault, "ack"), target=target)["ok"]
    assert emulated.run(sys.executable, "-c", program) == ""


@pytest.mark.parametrize("scheme", ["/dev/", "socket://", "rfc2217://"])
def test_pyserial_opens_the_serial_bus_and_the_stimulus_is_there(emulated: Emulated, scheme: str) -> None:
    place = next(place for place in emulated.places("daq0") if place.startswith(scheme))
    with serial.serial_for_url(place, baudrate=115200, timeout=5.0) as port:
        port.write(b"stop\r")
        assert port.read_until(b"stop\r").endswith(b"stop\r")
        for line in (b"encode 0", b"slist 0 1", b"srate 60000", b"dec 1"):
            port.write(line + b"\r")
            assert port.read_until(b"\r") == line + b"\r"
        port.write(b"start 0\r")
        volts = np.frombuffer(port.read(2 * 50), "<i2") * 10.0 / 32768
        port.write(b"stop\r")
        assert port.read_until(b"stop\r").endswith(b"stop\r")
    assert volts == pytest.approx(np.full(50, 1.5), abs=1e-3)  # 1.5 V is 0x1333: no byte of it ends the answer


def test_binary_data_pass_the_telnet_layer_unchanged(emulated: Emulated) -> None:
    """-1 is 0xFF 0xFF, which is the telnet command byte twice."""
    assert emulated.order(set={"daq.0": -10.0 / 32768})["ok"]
    place = next(place for place in emulated.places("daq0") if place.startswith("rfc2217"))
    with serial.serial_for_url(place, timeout=5.0) as port:
        port.write(b"stop\rencode 0\rslist 0 0\rsrate 60000\rdec 1\r")
        assert port.read_until(b"dec 1\r").endswith(b"dec 1\r")
        port.write(b"start 0\r")
        assert port.read(64) == b"\xff" * 64
        port.write(b"stop\r")
        port.read_until(b"stop\r")
    assert emulated.order(set={"daq.0": None})["ok"]


def test_a_second_tcp_client_is_refused_and_the_next_one_served(emulated: Emulated) -> None:
    address = ("127.0.0.1", int(emulated.places("piezo0")[1].rpartition(":")[2]))
    for _ in range(2):
        with socket.create_connection(address, 5.0) as first:
            first.sendall(b"*IDN?\n")
            assert first.makefile("rb").readline().startswith(b"(c)2016 Physik")
            with socket.create_connection(address, 5.0) as second:
                assert second.recv(1) == b""
        time.sleep(0.1)


def test_python_can_hears_the_node(emulated: Emulated) -> None:
    program = (
        "import can\n"
        "with can.Bus() as bus:\n"
        "    frames = [bus.recv(5.0) for _ in range(3)]\n"
        "print(*[hex(f.arbitration_id) for f in frames])"
    )
    assert len(emulated.run(sys.executable, "-c", program).split()) == 3


def test_emulated_time_waits_for_a_host_that_is_too_slow(emulated: Emulated) -> None:
    before_s = emulated.order(list=True)["stretched_s"]
    os.kill(emulated.described["pid"], signal.SIGSTOP)
    time.sleep(0.5)
    os.kill(emulated.described["pid"], signal.SIGCONT)
    emulated.order(list=True)
    assert emulated.order(list=True)["stretched_s"] - before_s > 0.45


def test_time_stands_still_while_it_is_paused(emulated: Emulated) -> None:
    # a world that waits in a loop for a time that stands still must not keep a processor from everybody
    assert os.sched_getscheduler(emulated.described["pid"]) == os.SCHED_OTHER
    assert emulated.order(pause=True)["ok"]
    first = emulated.order(list=True)["t_s"]
    time.sleep(0.05)
    assert emulated.order(list=True)["t_s"] == first
    assert emulated.order(advance_s=0.25)["ok"]
    until_s = time.monotonic() + 10.0
    while (now := emulated.order(list=True)["t_s"]) < first + 0.2499 and time.monotonic() < until_s:
        time.sleep(0.01)
    assert now == pytest.approx(first + 0.25, abs=1e-6)
    assert emulated.order(pause=False)["ok"]
    assert emulated.order(advance_s=0.25)["ok"] is False
    seen = json.loads(emulated.run(sys.executable, str(HERE / "use_i2c.py")))
    assert seen["who"] == 0x68


def test_ctrl_c_ends_it_and_nothing_is_left(tmp_path: Path) -> None:
    made = Emulated(tmp_path)
    pid, sockets = made.described["pid"], Path(made.described["control"]).parent
    assert made.close() == 130
    assert "stopped by Ctrl-C" in made.out.read_text()
    assert not sockets.exists()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_sigterm_as_a_job_of_a_ci_sends_it_leaves_nothing_either(tmp_path: Path) -> None:
    made = Emulated(tmp_path)
    pid, sockets = made.described["pid"], Path(made.described["control"]).parent
    assert made.close(signal.SIGTERM) == 128 + signal.SIGTERM
    assert not sockets.exists()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_a_wrong_key_of_the_emulation_names_the_bench(tmp_path: Path) -> None:
    text = (HERE / "one_chip.toml").read_text().replace('scenario = "rest"', 'scenario = "flying"')
    (tmp_path / "chip.toml").write_text(text, encoding="utf-8")
    command = [*MICRON, "emulate", "chip.toml", "--", "true"]
    done = subprocess.run(command, cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("micron: bench 'one chip': [emulation]: [endoscope.scenario] Input should be 'rest'")


def test_a_command_has_the_buses_and_its_exit_status_is_ours(tmp_path: Path) -> None:
    shutil.copy(HERE / "one_chip.toml", tmp_path)
    for program, said in (("one_chip.py", "WHO_AM_I 0x68"), ("control_example.py", '"imu.az": 3.0')):
        shutil.copy(HERE / program, tmp_path)
        command = [*MICRON, "emulate", "one_chip.toml", "--", sys.executable, program]
        done = subprocess.run(command, cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        assert said in done.stdout
    command = [*MICRON, "emulate", "one_chip.toml", "--", sys.executable, "-c", "raise SystemExit(7)"]
    assert subprocess.run(command, cwd=tmp_path, env=ENVIRONMENT, check=False).returncode == 7


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("nowhere",), "no such bench file"),
        (("{folder}/real.toml",), "no bus is emulated"),
        (("{folder}/bench.toml", "--stimulus", "daq.1"), "write it as"),
        (("{folder}/bench.toml", "--stimulus", "daq.1={folder}/no.csv:a"), "does not exist"),
        (("{folder}/bench.toml", "--stimulus", "daq.1={folder}/bare.csv:a"), "no time column"),
        (("{folder}/bench.toml", "--stimulus", "daq.1={folder}/bare.csv:a@0"), "not a rate"),
        (("{folder}/bench.toml", "--stimulus", "daq.11={folder}/bare.csv:a@10"), "no channel 'daq.11'"),
        (("{folder}/bench.toml", "--can", "nocan0"), "ip link add"),
        (("{folder}/bench.toml", "--tcp", "{busy}"), "TCP port"),
        (("{folder}/bench.toml", "--", "no-such-program"), "no such program"),
    ],
)
def test_bad_input_is_one_message(words: tuple[str, ...], said: str, tmp_path: Path) -> None:
    text = (HERE / "emulated.toml").read_text()
    (tmp_path / "bench.toml").write_text(text)
    (tmp_path / "real.toml").write_text(text.replace("sim://", "serial:///dev/none"))
    (tmp_path / "bare.csv").write_text("a,b\n1,2\n3,4\n")
    with socket.socket() as busy:
        busy.bind(("127.0.0.1", 0))
        busy.listen()
        places = {"folder": tmp_path, "busy": busy.getsockname()[1]}
        json_file = tmp_path / "out.json"
        command = ["emulate", "--json", str(json_file), *(word.format(**places) for word in words)]
        result = micron(*command)
    assert result.exit_code == 2
    assert said in result.stderr
    assert result.stderr.count("micron:") == 1
    assert not json_file.exists()


def test_without_a_compiler_the_message_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(i2c_shim.shutil, "which", lambda name: None)
    with pytest.raises(BenchError, match="apt install gcc"):
        build_shim()
    assert not any(tmp_path.rglob("*.so"))


def test_buses_keep_the_number_of_their_name_where_they_can() -> None:
    assert number_buses(["i2c0", "i2c1"]) == {"i2c0": 0, "i2c1": 1}
    assert number_buses(["a1", "b1", "outputs"]) == {"a1": 1, "b1": 0, "outputs": 2}


def test_the_node_hears_python_can(emulated: Emulated) -> None:
    """A heartbeat of the host on the bus's own group: nothing of it comes back as a frame of the node."""
    group, _, port = emulated.described["buses"]["can0"]["uri"].removeprefix("udp-multicast://").rpartition(":")
    with can.Bus(interface="udp_multicast", channel=group, port=int(port), hop_limit=0, fd=False) as bus:
        bus.send(can.Message(arbitration_id=0x123, data=struct.pack("<I", 7), is_extended_id=False))
        assert bus.recv(5.0) is not None
