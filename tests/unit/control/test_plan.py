"""A fact of the bench file has one owner; who needs it follows, and a contradiction is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers.options import AmplifierMonitorOptions, DacAmplifierOptions
from firmware_py.control.plan import load_plan
from firmware_py.control.wiring import open_devices
from hal.bench import load_bench, open_bench
from hal.errors import BenchError
from sim_devices.config import AmplifierConfig, emulation_config
from sim_devices.world import MONITOR_RATIO
from tests.conftest import DEFAULT_BENCH, with_keys


def bench_with(tmp_path: Path, *changes: tuple[str, str], actuation: str = "", more: str = "") -> Path:
    """The default bench without calibrations, with texts replaced, keys of ``[firmware.actuation]`` and ``more``."""
    text = "".join(
        line
        for line in DEFAULT_BENCH.read_text().splitlines(keepends=True)
        if not line.startswith(("calibration = ", "loop_delay_s = "))
    )
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    path = tmp_path / "bench.toml"
    path.write_text(with_keys(text, "firmware.actuation", actuation) + more)
    return path


def test_stage_and_emulation_follow_the_output(tmp_path: Path) -> None:
    limits = "neutral_V = 40.0\nlo_V = 5.0\nhi_V = 110.0\nslew_V_per_s = 9000.0"
    bench = load_bench(bench_with(tmp_path, ("neutral_V = 50.0", limits), ("gain = 20.0", "gain = 25.0")))
    act = load_plan(bench).stages.actuation
    assert (act.low_V, act.neutral_V, act.high_V, act.slew_V_per_s) == (5.0, 40.0, 110.0, 9000.0)
    emulated = emulation_config(bench.description.model_dump()).amplifier
    assert (emulated.low_V, emulated.neutral_V, emulated.high_V, emulated.gain) == (0.0, 40.0, 110.0, 25.0)


def test_a_stage_may_be_narrower_than_its_output(tmp_path: Path) -> None:
    path = bench_with(tmp_path, actuation="high_V = 90.0\n")
    assert load_plan(load_bench(path)).stages.actuation.high_V == 90.0


@pytest.mark.parametrize("given", ["low_V = -1.0", "high_V = 120.0", "neutral_V = 49.0", "slew_V_per_s = 20001.0"])
def test_a_stage_that_contradicts_its_output_is_refused(tmp_path: Path, given: str) -> None:
    path = bench_with(tmp_path, actuation=f"{given}\n")
    with pytest.raises(BenchError, match=rf"{given.split()[0]} = .* of \[device\.piezo\]: leave"):
        load_plan(load_bench(path))


def test_another_neutral_voltage_in_the_emulation_is_refused(tmp_path: Path) -> None:
    path = bench_with(tmp_path, more="[emulation.amplifier]\nneutral_V = 45.0\n")
    with pytest.raises(BenchError, match=r"neutral_V = 45\.0, but \[device\.piezo\] says 50\.0: leave"):
        emulation_config(load_bench(path).description.model_dump())


def test_the_estimator_follows_the_sensors_filter(tmp_path: Path) -> None:
    ohm = ("[firmware.sensing]", "[firmware.sensing]\nfilter_ohm = 40_000.0")
    stages = load_plan(load_bench(bench_with(tmp_path, ohm))).stages
    assert stages.tremor.filter_cutoff_rad_s == stages.sensing.cutoff_rad_s == 1.0 / (40_000.0 * 0.33e-6)


def test_what_the_emulation_assumes_of_a_bare_entry_is_the_drivers_default() -> None:
    output, emulated = DacAmplifierOptions(), AmplifierConfig()
    assert (emulated.gain, emulated.neutral_V) == (output.gain, output.neutral_V)
    assert (emulated.low_V, emulated.high_V) == (output.lo_V, output.hi_V)
    assert AmplifierMonitorOptions().ratio == MONITOR_RATIO


def test_a_second_device_that_the_instrument_would_ignore_is_refused(tmp_path: Path) -> None:
    bench = load_bench(bench_with(tmp_path, more='[device.other]\ndriver = "can_telemetry"\nbus = "can0"\n'))
    with (
        open_bench(bench, pace="virtual", runtime_dir=tmp_path) as opened,
        pytest.raises(BenchError, match="reads one can_telemetry, this bench has telemetry, other; remove all but one"),
    ):
        open_devices(opened)
