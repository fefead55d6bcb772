"""A bench's tick reaches every stage, or is refused with one message."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.wire import FAST_HZ, SETUPS, bench_file
from drivers.daq.di4108 import FIFO_SAMPLES
from firmware_py.app import run_in_process
from firmware_py.control.plan import load_plan
from firmware_py.control.stages import Stages
from firmware_py.run_request import RunRequest
from hal.bench import load_bench
from hal.errors import BenchError
from tests.conftest import DEFAULT_BENCH, with_keys


def bench_at(tmp_path: Path, tick_hz: int, actuation: str = "") -> Path:
    """The default bench at another rate, without its calibration."""
    text = DEFAULT_BENCH.read_text()
    text = text.replace("tick_hz = 1000", f"tick_hz = {tick_hz}").replace("rate_hz = 1000", f"rate_hz = {tick_hz}")
    lines = [line for line in text.splitlines() if not line.startswith(("calibration = ", "loop_delay_s = "))]
    path = tmp_path / "bench.toml"
    path.write_text(with_keys("\n".join(lines) + "\n", "firmware.actuation", actuation))
    return path


@pytest.mark.parametrize("tick_hz", [500, 1000])
def test_every_stage_is_designed_for_the_clock(tmp_path: Path, tick_hz: int) -> None:
    configs = load_plan(load_bench(bench_at(tmp_path, tick_hz))).stages
    stages = Stages(configs)
    assert stages.sensing.params["attitude"]["dt_s"][0] == pytest.approx(1.0 / tick_hz)
    assert stages.actuation.params["tick_hz"][0] == tick_hz
    assert configs.tremor.tick_hz == tick_hz


def test_a_stage_that_names_another_rate_is_refused(tmp_path: Path) -> None:
    path = bench_at(tmp_path, 500, "tick_hz = 1000.0\n")
    with pytest.raises(BenchError, match=r"firmware\.actuation: tick_hz = 1000\.0, but \[clock\] tick_hz is 500"):
        load_plan(load_bench(path))


def test_taps_of_another_rate_are_refused(tmp_path: Path) -> None:
    path = bench_at(tmp_path, 500, "feedforward = [1.2, -0.2]\n")
    with pytest.raises(BenchError, match=r"the taps of feedforward are for ticks of 1000 Hz, this bench has 500 Hz"):
        load_plan(load_bench(path))
    same = bench_at(tmp_path, 500, "feedforward = [1.2, -0.2]\ntick_hz = 500.0\n")
    assert load_plan(load_bench(same)).stages.actuation.feedforward[0] == (1.2, -0.2)


def test_scans_are_taken_in_while_a_slow_output_is_armed(tmp_path: Path) -> None:
    """An E-727 is armed for 39 ms; the DAQ holds the scans of 32 ms at 4 kHz."""
    bench = bench_file(next(setup for setup in SETUPS if setup.tick_hz == FAST_HZ), tmp_path)
    outcome, _ = run_in_process(RunRequest(bench, 0.05, pace="virtual"))
    assert outcome["ticks"]["announced"]["arming"]["caught_up"] > FIFO_SAMPLES // 8
    assert outcome["holds"] == []
    assert outcome["samples"]["lost"] == 0
    assert outcome["safe_state"]["normal"]
