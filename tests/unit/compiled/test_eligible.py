"""Which benches can run compiled: the reason names the device; asked for, it is bad input."""

from __future__ import annotations

from pathlib import Path

import pytest

from firmware_py.compiled.eligible import check_compiled, reasons_against_bench
from hal.bench import load_bench
from hal.errors import BenchError
from tests.command import micron

BENCHES = Path(__file__).parents[3] / "benches"


def reasons(name: str) -> str:
    return "; ".join(reasons_against_bench(load_bench(BENCHES / f"{name}.toml"), "realtime"))


@pytest.mark.parametrize("bench", ["micron", "micron-e727", "micron-can"])
def test_these_benches_can(bench: str):
    assert reasons(bench) == ""
    check_compiled(load_bench(BENCHES / f"{bench}.toml"), "realtime")


@pytest.mark.parametrize(
    ("bench", "what"),
    [
        ("micron-eight", "device.acc1, device.acc2, device.acc3, device.acc4: 8 accelerometer axes"),
        ("endoscope", "an endoscope's loop is Python"),
    ],
)
def test_others_say_which_device_and_why(bench: str, what: str):
    assert what in reasons(bench)


@pytest.mark.parametrize(
    ("uri", "answer"),
    [
        ("socketcan://can0", ""),
        ("slcan:///dev/ttyUSB0", "device.piezo: its bus slcan:///dev/ttyUSB0 has no socket"),
        ("sim://can0?via=slcan", "device.piezo: its bus sim://can0?via=slcan has no socket"),
    ],
)
def test_a_can_bus_needs_a_socket_of_single_frames(tmp_path: Path, uri: str, answer: str):
    file = tmp_path / "bench.toml"
    file.write_text((BENCHES / "micron-can.toml").read_text().replace("sim://can0", uri))
    found = "; ".join(reasons_against_bench(load_bench(file), "realtime"))
    assert found.startswith(answer)
    assert bool(found) == bool(answer)


def test_emulated_time_and_injected_faults_are_python():
    with pytest.raises(BenchError, match=r"--realtime.*--inject"):
        check_compiled(load_bench(BENCHES / "micron-e727.toml"), "paced", injected=True)


def bench_of_ni(folder: Path) -> Path:
    """Return the default bench with a National Instruments card in place of DAQ and amplifier."""
    text = (BENCHES / "micron.toml").read_text()
    text = text.replace('driver = "di4108"\nbus = "daq0"', 'driver = "nidaqmx"\ndevice = "Dev1"')
    text = text.replace(
        'driver = "dac_amplifier"\nbus = "i2c0"\naddress = 0x0C', 'driver = "nidaqmx_ao"\ndevice = "Dev1"'
    )
    file = folder / "ni.toml"
    file.write_text(text)
    return file


def test_each_device_without_kernels_is_named(tmp_path: Path):
    assert reasons_against_bench(load_bench(bench_of_ni(tmp_path)), "realtime") == [
        "device.daq: its driver nidaqmx has no kernels on bytes",
        "device.piezo: its driver nidaqmx_ao has no kernels on bytes",
    ]


@pytest.mark.parametrize(
    ("bench", "what"),
    [
        ("micron-eight", "device.acc1, device.acc2, device.acc3, device.acc4: 8 accelerometer axes"),
        ("endoscope", "an endoscope's loop is Python"),
        ("imus", "an endoscope's loop is Python"),
        ("NI", "device.daq: its driver nidaqmx has no kernels on bytes; device.piezo: its driver nidaqmx_ao has no"),
    ],
)
def test_asked_for_it_is_bad_input(tmp_path: Path, bench: str, what: str):
    record = tmp_path / "run.mcap"
    file = str(bench_of_ni(tmp_path) if bench == "NI" else BENCHES / f"{bench}.toml")
    result = micron("run", "--bench", file, "--realtime", "--compiled", "--record", record)
    assert result.exit_code == 2
    assert what in " ".join(result.output.split())
    assert not record.exists()


@pytest.mark.parametrize("command", [["bench", "--realtime"], ["latency"]], ids=lambda words: words[0])
@pytest.mark.parametrize(
    ("bench", "what"),
    [
        ("micron-eight", "device.acc1, device.acc2, device.acc3, device.acc4: 8 accelerometer axes"),
        ("endoscope", "an endoscope's loop is Python"),
        ("NI", "device.daq: its driver nidaqmx has no kernels on bytes; device.piezo: its driver nidaqmx_ao has no"),
    ],
)
def test_asked_for_it_is_bad_input_of_every_command(tmp_path: Path, command: list[str], bench: str, what: str):
    file = str(bench_of_ni(tmp_path) if bench == "NI" else BENCHES / f"{bench}.toml")
    made = tmp_path / "made"
    own = ["--recordings", str(made)] if command[0] == "bench" else ["--json", str(made)]
    result = micron(*command, "--bench", file, "--compiled", *own)
    assert result.exit_code == 2
    assert f"micron: {file}: --compiled cannot run: " in " ".join(result.output.split())
    assert what in " ".join(result.output.split())
    assert not made.exists()


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (["bench", "--compiled"], "--compiled cannot run: emulated time passes in Python (--realtime runs on"),
        (["latency", "--compiled", "--no-firmware"], "--no-firmware leaves it out"),
    ],
)
def test_what_excludes_it_is_bad_input_of_every_command(words: list[str], what: str):
    result = micron(*words)
    assert result.exit_code == 2
    assert what in " ".join(result.output.split())


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["--inject", "daq0:loss=0.001"], "--inject is Python between the loop and a device"),
        (["--sense-only"], "--sense-only moves no outputs, and the compiled thread runs while they move"),
    ],
)
def test_a_run_says_which_of_its_options_keeps_it_in_python(
    monkeypatch: pytest.MonkeyPatch, words: list[str], why: str
):
    def stop(*_: object) -> None:
        raise BenchError("the run is not part of this test")

    monkeypatch.setattr("tools.cli.run.prepare", stop)
    result = micron("run", "--realtime", "--bench", BENCHES / "micron.toml", *words)
    said = " ".join(result.output.split())
    assert f"loop: Python, because this run cannot be compiled: {why} micron:" in said
    assert "--compiled runs it" not in said


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (["--spin-us", "50"], "--spin-us belongs to --compiled"),
        (["--compiled", "--spin-us", "300"], "outside 0 .. 250 us"),
        (["--cpu", "4095"], "name one of them"),
    ],
)
def test_a_spin_or_a_processor_that_cannot_be_is_bad_input(words: list[str], what: str):
    bench = str(BENCHES / "micron-e727.toml")
    result = micron("run", "--bench", bench, "--realtime", *words)
    assert result.exit_code == 2
    assert what in " ".join(result.output.split())


def test_a_processor_is_of_real_time():
    result = micron("run", "--virtual", "--cpu", "0")
    assert result.exit_code == 2
    assert "--realtime" in result.output
