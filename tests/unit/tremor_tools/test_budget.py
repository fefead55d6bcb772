"""The budget's benches: one source gone in each, everything else as it was."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from firmware_py.control.plan import load_plan
from hal.bench import load_bench
from sim_devices.config import EmulationConfig
from tests.command import micron
from tools.reports.figures import FOUR_BANDS_HZ, TREMOR_BAND_HZ
from tools.research.tremor import budget
from tools.research.tremor.bench_variant import write_variant
from tools.research.tremor.budget import MADE, sources

BENCH = Path(__file__).parents[3] / "benches" / "micron.toml"


def test_the_first_row_is_the_bench_as_it_is(tmp_path: Path) -> None:
    first = next(iter(sources(BENCH).values()))
    table = tomllib.loads(write_variant(BENCH, first, tmp_path, "same").read_text(encoding="utf-8"))
    assert table["emulation"] == tomllib.loads(BENCH.read_text(encoding="utf-8"))["emulation"]


@pytest.mark.parametrize("source", sorted(MADE))
def test_a_part_that_is_made_perfect_loses_its_calibration(tmp_path: Path, source: str) -> None:
    file = write_variant(BENCH, sources(BENCH)[source], tmp_path, "made")
    table = tomllib.loads(file.read_text(encoding="utf-8"))
    assert sorted(Path(name).stem for name in table["firmware"]["calibration"]) == sorted(
        {"sensors", "piezo", "manipulator"} - {MADE[source][0]}
    )
    config = EmulationConfig.model_validate(table["emulation"])
    assert config.sensors.noise_ug_per_rtHz > 0.0  # noise is another row's
    load_plan(load_bench(file))


def test_an_endoscope_has_no_budget_of_tremor() -> None:
    result = micron("tremor", "budget", "--bench", BENCH.with_name("endoscope.toml"))
    assert result.exit_code == 2
    assert "belongs to the instrument" in result.output


@pytest.mark.slow
def test_a_source_costs_what_the_error_gains_by_it_in_each_band(monkeypatch: pytest.MonkeyPatch) -> None:
    """Power adds up: cost^2 is the error's power with everything on less that without the source."""
    quiet = "accelerometer noise"
    monkeypatch.setattr(budget, "sources", lambda _: {"everything on": {}, quiet: {"emulation": budget.SOURCES[quiet]}})
    whole, noise = budget.budget(BENCH, 8.0, lambda _: None)
    assert [(b.low_Hz, b.high_Hz) for b in noise.bands] == list(FOUR_BANDS_HZ)
    assert [b.cost_um for b in whole.bands] == pytest.approx([b.with_um for b in whole.bands])
    for before, after in zip(whole.bands, noise.bands, strict=True):
        assert after.cost_um * abs(after.cost_um) == pytest.approx(before.with_um**2 - after.with_um**2)
    tremor = noise.bands[FOUR_BANDS_HZ.index(TREMOR_BAND_HZ)]
    assert noise.as_dict()["cost_um"] == tremor.cost_um > 0.5


def test_the_last_rows_keep_still_above_the_band_as_the_bench_does() -> None:
    """The bound beside which ``ideal_changes`` is run pays nothing there; a budget of that band does."""
    ideal = sources(BENCH)["all errors of sensors and actuators"]["firmware"]
    assert not {"quiet", "above"} & set(ideal["tremor"]["adaptive"])
    assert "overdrive" not in ideal["actuation"]
