"""The pytest plugin in an empty project, and the ports of a virtual bench."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np
import pytest
from smbus2 import i2c_msg

from hal.errors import BenchError
from tools.emulate.virtual import open_named, open_part
from tools.errors import InputError

ROOT = Path(__file__).parents[3]
EXAMPLE = Path(__file__).with_name("ten_lines.py")
EVERYTHING = """
import numpy as np
import pytest


def test_a_column_is_heard_and_time_passes_only_when_it_is_told_to(emulated, stimulus, truth):
    bench = emulated("di4108")
    stimulus(bench, "di4108.0", np.linspace(0.0, 5.0, 11), rate_hz=10)
    port = bench.serial()
    port.write(b"stop\\rencode 0\\rslist 0 0\\rsrate 60000\\rdec 1\\r")
    port.reset_input_buffer()
    port.write(b"start\\r")
    volts = np.frombuffer(port.read(1000), "<i2") * 10.0 / 32768
    assert volts == pytest.approx(5.0 * np.arange(1, 501) * 1e-3, abs=1e-3)
    assert bench.now_s == pytest.approx(0.504, abs=1e-3)  # 63 packets of 8 scans
    before = bench.now_s
    stimulus(bench, "di4108.0", -2.0)
    assert truth(bench)["di4108.0"] == -2.0
    assert bench.now_s == before
    bench.advance(0.25)
    assert bench.now_s == pytest.approx(before + 0.25)


def test_a_bench_that_ships(micron_bench):
    assert micron_bench("imus").smbus().read_byte_data(0x69, 0x75) == 0x68
"""


def test_an_empty_project_has_the_fixtures(tmp_path: Path) -> None:
    shutil.copy(EXAMPLE, tmp_path / "test_dac.py")
    (tmp_path / "test_more.py").write_text(EVERYTHING, encoding="utf-8")
    is_installed = any(entry.name == "micron" for entry in entry_points(group="pytest11"))
    plugin = [] if is_installed else ["-p", "micron_pytest"]
    command = [sys.executable, "-m", "pytest", *plugin, "-q", "-p", "no:cacheprovider", "-W", "error"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert "3 passed" in done.stdout


def test_the_example_has_ten_lines() -> None:
    lines = [line for line in EXAMPLE.read_text().splitlines() if line and not line.startswith("import")]
    assert len(lines) <= 10


def test_the_plugin_imports_nothing_heavy() -> None:
    program = "import sys, pytest; old = set(sys.modules); import micron_pytest; print(*set(sys.modules) - old)"
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "tools" / "start")}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) <= {
        "micron_start",
        "micron_pytest",
        "importlib.machinery",
        "importlib.abc",
        "importlib",
    }


@pytest.mark.slow
def test_the_built_wheel_brings_the_fixtures(tmp_path: Path) -> None:
    """In an environment of its own, away from the sources: no option, no conftest."""
    uv = Path(sys.executable).with_name("uv")
    pins = ["-c", str(ROOT / "constraints.txt"), "-b", str(ROOT / "constraints.txt")]
    python = tmp_path / "venv" / "bin" / "python"
    project = tmp_path / "project"
    project.mkdir()
    shutil.copy(EXAMPLE, project / "test_dac.py")
    environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "VIRTUAL_ENV")}
    for command in (
        [str(uv), "build", "--quiet", *pins[2:], "--wheel", "--out-dir", str(tmp_path), str(ROOT)],
        [str(uv), "venv", "--quiet", "--python", sys.executable, str(tmp_path / "venv")],
    ):
        subprocess.run(command, env=environment, check=True)
    wheel = next(tmp_path.glob("*.whl"))
    install = [str(uv), "pip", "install", "--quiet", "--python", str(python), *pins, str(wheel), "pytest"]
    subprocess.run(install, env=environment, check=True)
    command = [str(python), "-m", "pytest", "-q", "-p", "no:cacheprovider"]
    done = subprocess.run(command, cwd=project, env=environment, capture_output=True, text=True, check=False)
    assert "1 passed" in done.stdout, done.stdout + done.stderr


def test_the_smbus_shape() -> None:
    bench = open_part("ads1115", address=0x48)
    bench.put("ads1115.0", 1.0)
    with bench.smbus() as bus:
        assert bus.read_i2c_block_data(0x48, 0x01, 2) == [0x85, 0x83]
        assert bus.read_word_data(0x48, 0x01) == 0x8385
        bus.write_word_data(0x48, 0x01, 0x83C3)  # 0xC383: input 0 alone, +-4.096 V, one conversion
        bench.advance(0.02)
        write, read = i2c_msg.write(0x48, [0x00]), i2c_msg.read(0x48, 2)
        bus.i2c_rdwr(write, read)
        assert int.from_bytes(bytes(read), "big") == pytest.approx(1.0 / 125e-6 * 4.096 / 4.096, abs=2)
        bus.write_byte(0x48, 0x01)
        assert bus.read_byte(0x48) == 0xC3
        bus.write_quick(0x48)
        bus.write_byte_data(0x48, 0x02, 0x80)
        with pytest.raises(OSError, match="check wiring") as absent:
            bus.read_byte_data(0x49, 0x00)
        assert absent.value.errno == errno.ENXIO
        bench.fault("stuck", "bus0")
        with pytest.raises(OSError, match="SDA") as stuck:
            bus.read_byte(0x48)
        assert stuck.value.errno == errno.EIO
        with pytest.raises(OSError, match="one address"):
            bus.i2c_rdwr(i2c_msg.write(0x48, [0]), i2c_msg.read(0x49, 1))
    bench.close()


def test_the_serial_shape() -> None:
    bench = open_part("e727")
    with bench.serial(timeout=0.5) as port:
        port.write(b"SVO 1 1\nMOV 1 5\n")
        bench.advance(1.0)
        port.write(b"POS? 1\n")
        assert float(port.readline().decode().partition("=")[2]) == pytest.approx(5.0, abs=0.01)
        before_s = bench.now_s
        assert port.read(1) == b""
        assert bench.now_s - before_s == pytest.approx(0.5, abs=1e-9)  # the time-out passes in virtual time
        port.write(b"CSV?\nCSV?\n")
        bench.advance(0.1)
        assert port.in_waiting == 8
        assert port.read_until(b".") == b"2."
        assert port.read_all() == b"0\n2.0\n"
        port.flush()
    bench.close()


def test_what_cannot_be_emulated_is_said() -> None:
    with pytest.raises(BenchError, match="there is no driver 'abacus'"):
        open_part("abacus")
    with pytest.raises(BenchError, match=r"\[device.ad5696r\] has no address"):
        open_part("ad5696r")
    with pytest.raises(InputError, match="these do: endoscope"):
        open_named("nowhere")
    bench = open_named(ROOT / "tests" / "wire" / "emulators" / "emulated.toml")
    with pytest.raises(BenchError, match="name one of the buses"):
        bench.port()
    with pytest.raises(ValueError, match="channels are"):
        bench.put("imu.height", np.zeros(3), 10.0)
    bench.put("imu.ax", 1.0)
    bench.put("imu.ax", None)
    assert bench.part is not None
    bench.close()
