"""Driver and emulator against the data sheet's figures, each alone; then the default bench with it as its output."""

import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import benches
from drivers.registry import Site, find_driver
from firmware_py.app import run_in_process
from firmware_py.run_request import RunRequest
from hal.bench import DeviceSpec
from hal.clock import VirtualClock
from hal.errors import WrongDevice
from hal.types import I2cRead
from sim_devices.registry import Surroundings, find_device

ANSWER = "c09800c09800d09800d09800e09800e09800f0{}f09800"  # figure 5-15, address pins 0


def driver(*answers: str):
    """The driver on a bus that notes what is written and gives ``answers`` to reads."""
    written, left = [], list(answers)

    def transfer(address, ops):
        assert address == 0x60
        written.extend(op.data.hex() for op in ops if not isinstance(op, I2cRead))
        return bytes.fromhex(left.pop(0)) if isinstance(ops[-1], I2cRead) else b""

    found = find_driver("mcp4728")
    bench = SimpleNamespace(i2c=lambda bus: SimpleNamespace(transfer=transfer), clock=VirtualClock())
    spec = DeviceSpec(driver="mcp4728", bus="i2c0", address=0x60)
    return found.open(Site("piezo", spec, found.options(gain=25.0), bench)), written


def test_the_driver_speaks_as_figures_5_7_5_8_and_5_15_say():
    rest = ANSWER.format("95a5")[:30]
    neutral = rest.replace("9800", "97d0")
    piezo, written = driver(ANSWER.format("9a5a"), ANSWER.format("95a5"), rest, neutral, neutral, rest)
    assert piezo.probe() == "MCP4728 at 0x60, 0 .. 100 V"
    piezo.arm()
    assert written[:2] == ["469a5a", "4695a5"]  # multi-write to D, internal reference, gain 2
    assert written[-1] == "07d007d007d0"  # fast write of 2000 = 50 V / 102.4 V x 4096 to A, B, C
    assert piezo.verify() == ""
    assert piezo.verify() == "output 1 holds 51.200 V and was told 50.000 V"
    with pytest.raises(WrongDevice, match="not an MCP4728"):
        driver("00" * 24)[0].probe()
    external = [ANSWER.format(word).replace("c09800", "c00800") for word in ("9a5a", "95a5")]
    with pytest.raises(WrongDevice, match="gain 2"):
        driver(*external)[0].probe()


def test_the_emulator_answers_as_figures_7_4_and_5_15_say():
    around = Surroundings("piezo", {"address": 0x60}, 1, 0, lambda t_ns: None, None)
    chip = find_device("mcp4728").make(around)
    assert chip.read(24, 0).hex() == ANSWER.format("9800")
    chip.write(bytes.fromhex("400800420fff449800469fff"), 1)  # the words of figure 7-4
    assert chip.output_V == pytest.approx([2.5, 5.0 * 4095 / 4096, 2.048, 4.095])
    chip.write(bytes.fromhex("0fff07ff"), 2)  # figure 7-5: A and B, reference and gain stay
    assert chip.output_V == pytest.approx([5.0 * 4095 / 4096, 5.0 * 2047 / 4096, 2.048, 4.095])


def test_it_runs_as_the_output_of_the_default_bench(tmp_path: Path):
    ours = Path(benches.__file__).parent
    shutil.copytree(ours / "calibration", tmp_path / "calibration")
    text = (ours / "micron.toml").read_text()
    for old, new in (('"dac_amplifier"', '"mcp4728"'), ("0x0C", "0x60"), ("gain = 20.0", "gain = 25.0")):
        assert text.count(old) == 1
        text = text.replace(old, new)
    bench = tmp_path / "bench.toml"
    bench.write_text(text)
    outcome, truth = run_in_process(RunRequest(bench, 1.0, pace="virtual"), runtime_dir=tmp_path)
    assert (outcome["safe_state"]["normal"], outcome["guardian"] is not None) == (True, True)
    assert outcome["devices"]["piezo"] == "MCP4728 at 0x60, 0 .. 100 V"
    assert outcome["commands"]["sent"] >= 999
    assert outcome["commands"]["clipped"] == 0
    assert outcome["noticed"] == {}
    moved_m = np.ptp(np.asarray(truth["tip_m"]) - np.asarray(truth["tip_rigid_m"]), axis=0)
    assert np.all(moved_m > 1e-6)
