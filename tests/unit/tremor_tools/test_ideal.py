"""The ideal instrument's bench file, and its bound against a loop whose residual is known."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from firmware_py.control.plan import load_plan
from hal.bench import load_bench
from sim_devices.config import EmulationConfig
from sim_devices.plant.unit import build_unit
from tools.research.tremor.bench_variant import merged, write_variant
from tools.research.tremor.cases import emulated_hand
from tools.research.tremor.ideal import POSITIONS_M, ideal_changes, residuals

BENCH = Path(__file__).parents[3] / "benches" / "micron.toml"


def test_a_variant_is_the_bench_with_the_changes(tmp_path: Path) -> None:
    changes = {"emulation": {"sensors": {"daq_noise_uV": 0.0}}, "name": 'odd "name" µ'}
    file = write_variant(BENCH, changes, tmp_path, "other")
    made, before = (tomllib.loads(path.read_text(encoding="utf-8")) for path in (file, BENCH))
    assert made["name"] == changes["name"]
    assert made["emulation"] == {**before["emulation"], "sensors": {"daq_noise_uV": 0.0}}
    for key in set(before) - {"name", "emulation", "firmware"}:
        assert made[key] == before[key]
    assert all(Path(name).is_file() for name in made["firmware"]["calibration"])


def test_merging_touches_neither() -> None:
    table, changes = {"a": {"b": 1, "c": 2}, "d": [1]}, {"a": {"b": 3}, "d": [2]}
    assert merged(table, changes) == {"a": {"b": 3, "c": 2}, "d": [2]}
    assert table == {"a": {"b": 1, "c": 2}, "d": [1]}


@pytest.mark.parametrize("noise", [True, False])
def test_the_firmware_is_told_the_ideal_instrument_as_it_is(tmp_path: Path, noise: bool) -> None:
    file = write_variant(BENCH, ideal_changes(noise), tmp_path, "ideal")
    table = tomllib.loads(file.read_text(encoding="utf-8"))["emulation"]
    config = EmulationConfig.model_validate(table)
    stages = load_plan(load_bench(file)).stages
    places = np.array(config.instrument.positions_mm) * 1e-3
    np.testing.assert_allclose(np.array(POSITIONS_M), places, atol=1e-12)
    assert stages.sensing.tip_m == tuple(1e-3 * v for v in config.instrument.tip_mm)
    units = [build_unit(config, seed) for seed in (1, 2)]
    # two units are the same one: nothing is drawn any more
    assert units[0].manipulator.shaft_m == units[1].manipulator.shaft_m == stages.actuation.shaft_m
    assert units[0].manipulator.circle_m == stages.actuation.ball_circle_m
    np.testing.assert_allclose(units[0].manipulator.lever, stages.actuation.lever_gain)
    np.testing.assert_allclose(units[0].manipulator.mount, np.eye(3), atol=1e-12)
    assert (config.sensors.noise_ug_per_rtHz > 0.0) == noise


def test_a_loop_that_does_nothing_leaves_the_whole_and_the_bound_a_part() -> None:
    hand = emulated_hand(5, 16.0)
    assert hand.slow is not None
    rigid = hand.slow + hand.truth
    truth = {"tip_rigid_m": rigid, "tip_m": rigid, "intended_m": hand.slow}
    keep = np.zeros(len(rigid), dtype=np.bool_)
    keep[5000:-1000] = True
    loop, alone, bound = residuals(truth, keep, noise=True)
    assert 0.03 < bound / loop < 0.25
    assert bound < alone < 1.2 * bound
    # a loop that leaves half of it all
    half, _, same = residuals({**truth, "tip_m": hand.slow + 0.5 * hand.truth}, keep, noise=True)
    assert half == pytest.approx(0.5 * loop, rel=1e-6)
    assert same == bound
