"""One registry for built-ins, folders of this tree and packages of others."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import drivers
import sim_devices.parts
from drivers.bus_use import bus_uses
from drivers.polling import polling_of
from drivers.registry import BUILT_IN, REGISTRY, Driver, driver_names, find_driver
from drivers.specs import check_devices
from firmware_py.app import run_in_process
from firmware_py.endoscope.wiring import is_endoscope
from firmware_py.run_request import RunRequest
from hal.bench import load_bench
from hal.errors import BenchError
from tests.conftest import DEFAULT_BENCH

PACKAGE = Path(__file__).parents[2] / "examples" / "i2c_dac"
CHANGES = (('"dac_amplifier"', '"mcp4728"'), ("0x0C", "0x60"), ("gain = 20.0", "gain = 25.0"))


@pytest.fixture
def two_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Driver and emulator of the example as the folders ``drivers/mcp4728`` and ``sim_devices/parts/mcp4728``.

    They stand in a folder of the test that the two packages look into as well, so that no other test sees them.
    """
    for package, source, target in (
        (drivers, "mcp4728.py", "driver.py"),
        (sim_devices.parts, "emulated_mcp4728.py", "device.py"),
    ):
        tree = tmp_path / package.__name__
        folder = tree / "mcp4728"
        folder.mkdir(parents=True)
        (folder / "__init__.py").touch()
        shutil.copy(PACKAGE / source, folder / target)
        monkeypatch.setattr(package, "__path__", [*package.__path__, str(tree)])
    yield
    for name in [name for name in sys.modules if ".mcp4728" in name]:
        del sys.modules[name]
    for package in (drivers, sim_devices.parts):
        vars(package).pop("mcp4728", None)


def bench_with_it(tmp_path: Path) -> Path:
    """The default bench with an MCP4728 as its output."""
    shutil.copytree(DEFAULT_BENCH.parent / "calibration", tmp_path / "calibration")
    text = DEFAULT_BENCH.read_text()
    for old, new in CHANGES:
        assert text.count(old) == 1
        text = text.replace(old, new)
    path = tmp_path / "bench.toml"
    path.write_text(text)
    return path


def test_every_built_in_is_a_record_of_its_module() -> None:
    assert all(isinstance(REGISTRY.find(name), Driver) for name in BUILT_IN)
    assert set(BUILT_IN) <= set(driver_names())
    with pytest.raises(BenchError, match=r"there is no driver 'ad5696'; drivers are di4108, "):
        find_driver("ad5696")


@pytest.mark.usefixtures("two_folders")
def test_two_folders_are_a_new_output_of_the_default_bench(tmp_path: Path) -> None:
    bench = bench_with_it(tmp_path)
    outcome, truth = run_in_process(RunRequest(bench, 0.3, pace="virtual"), runtime_dir=tmp_path)
    assert find_driver("mcp4728").open.__module__ == "drivers.piezo.dac_output"
    assert find_driver("mcp4728").leased.__module__ == "drivers.mcp4728.driver"
    assert outcome["devices"]["piezo"] == "MCP4728 at 0x60, 0 .. 100 V"
    assert outcome["safe_state"]["normal"]
    assert outcome["guardian"] is not None
    assert outcome["commands"]["sent"] >= 299
    assert truth is not None
    assert np.all(np.isfinite(truth["tip_m"]))


@pytest.mark.usefixtures("two_folders")
def test_its_options_addresses_and_load_are_checked_like_ours(tmp_path: Path) -> None:
    path = bench_with_it(tmp_path)
    description = load_bench(path).description
    options = check_devices(description, "")
    polling, _ = polling_of(description, options)
    uses = {use.what: use for use in bus_uses(description, options, polling) if use.device == "piezo"}
    assert (uses["command"].bits, uses["command"].per_s, uses["command"].task) == (65, 1000.0, "actuate")
    assert (uses["verify"].bits, uses["verify"].task) == (146, "verify")
    assert not is_endoscope(description)
    for old, new, message in (
        ("0x60", "0x0C", r"address\] 0x0C is not one of 0x60\.\.0x67"),
        ("gain = 25.0\n", "", r"gain"),
        ("gain = 25.0", "gain = 25.0\nread_back = true", r"read_back"),
        (
            '"sim://i2c0"\nspeed_hz = 400_000',
            '"sim://i2c0"\nspeed_hz = 1_000_000',
            r"'piezo' allows; set at most 400000",
        ),
    ):
        text = path.read_text()
        assert text.count(old) == 1
        other = tmp_path / "other.toml"
        other.write_text(text.replace(old, new))
        with pytest.raises(BenchError, match=message):
            check_devices(load_bench(other).description, "")
