"""A heal keeps what helps on every band and reverts the rest; what it cannot do is refused by one message."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from firmware_py.control.plan import load_plan
from hal.bench import BenchFile, load_bench
from tools.bench.bench_copy import with_calibration
from tools.cli.main import app
from tools.heal.balance import LEAST_RELATIVE, MOST_QUIET, Balance
from tools.heal.figures import BANDS, WHOLE, TipError, is_better, tip_error
from tools.heal.heal import TRY_FROM, VERIFY_RUNS, Healed, Remedy, Step, Trial, heal, lines, with_remedy
from tools.heal.parts import Comparison, Lab, Part, compare_manipulator, compare_sensors, compare_stacks

ROOT = Path(__file__).parents[3]
MICRON = ROOT / "benches/micron.toml"


def errors(shift: dict[str, float], spread: float = 0.1, count: int = 8) -> TipError:
    rng = np.random.default_rng(3)
    return TipError({b: 5.0 + shift.get(b, 0.0) + spread * rng.standard_normal(count) for b in (*BANDS, WHOLE)})


def test_less_error_in_the_whole_band_is_better():
    kept, why = is_better(errors({}), errors({WHOLE: -1.0, "8-12 Hz": -1.0}))
    assert kept
    assert "falls by 1 um" in why


@pytest.mark.parametrize("band", BANDS)
def test_a_band_that_gets_worse_reverts_it(band: str):
    kept, why = is_better(errors({}), errors({WHOLE: -1.0, band: 0.5}))
    assert not kept
    assert f"{band} rises by 0.5 um" in why


def test_a_whole_that_rises_reverts_it():
    assert not is_better(errors({}), errors({WHOLE: 1.0, "8-12 Hz": -1.0}))[0]


def test_what_changes_nothing_is_reverted():
    assert not is_better(errors({}), errors({}))[0]


def test_a_fall_that_is_too_small_to_matter_is_reverted():
    before = errors({})
    after = TipError({b: v - 0.001 for b, v in before.bands.items()})
    kept, why = is_better(before, after)
    assert not kept
    assert "1% or more" in why


def scripted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, after) -> Trial:
    """Return a trial in which ``after(balance)`` gives the shift of each band of a bench with the remedy."""
    balances: list[Balance] = []

    def apply(self: Remedy, to: BenchFile, balance: Balance) -> BenchFile:
        balances.append(balance)
        return to

    def measured(bench: BenchFile, seconds: float, seeds) -> TipError:
        return errors(after(balances[-1]) if balances else {})

    monkeypatch.setattr(Remedy, "apply", apply)
    monkeypatch.setattr("tools.heal.heal.tip_error", measured)
    return Trial(12.0, range(8))


def tried(trial: Trial, tmp_path: Path) -> tuple[bool, Balance, str]:
    candidate, balance, why = trial.run(load_bench(MICRON), Remedy(*(tmp_path / n for n in "abc")))
    return candidate is not None, balance, why


def test_a_remedy_that_costs_slow_bands_is_weighed_anew(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    trial = scripted(monkeypatch, tmp_path, lambda b: {"8-12 Hz": -1.0, "2-8 Hz": 0.15 - 0.1 * b.fade_hz})
    assert tried(trial, tmp_path)[:2] == (True, Balance(fade_hz=2.0))


def test_weights_alone_are_no_reason_to_keep_a_remedy(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    trial = scripted(monkeypatch, tmp_path, lambda b: {WHOLE: -b.fade_hz, "2-8 Hz": 0.1})
    accepted, balance, why = tried(trial, tmp_path)
    assert not accepted
    assert balance == Balance()
    assert "1% or more" in why


def test_a_band_that_rises_with_all_weights_reverts_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    trial = scripted(monkeypatch, tmp_path, lambda b: {"8-12 Hz": -1.0, "20-500 Hz": 0.1})
    accepted, balance, why = tried(trial, tmp_path)
    assert not accepted
    assert balance == Balance(quiet=MOST_QUIET, relative=LEAST_RELATIVE)
    assert "but 20-500 Hz rises by 0.1 um" in why


def test_a_balance_says_what_it_changes():
    assert str(Balance(fade_hz=1.0, drift=2.0)) == "cancelling from 1 Hz higher, drift x 2"
    assert str(Balance(relative=0.5)) == "relative x 0.5"


def test_a_balance_changes_three_weights_and_keeps_the_others(tmp_path: Path):
    bench = load_bench(MICRON)
    was = load_plan(bench).stages.tremor.adaptive
    file = tmp_path / "weights.toml"
    file.write_text(Balance(1.0, 2.0, 4.0, 0.5).calibration(bench))
    tremor = load_plan(load_bench(with_calibration(bench, file, tmp_path / "bench.toml"))).stages.tremor
    expected = {
        "cancel_from_hz": (4.0, 7.0),
        "quiet": 2.0 * was.quiet,
        "drift_m_s2": 4.0 * was.drift_m_s2,
        "relative": 0.5 * was.relative,
    }
    assert tremor.adaptive == was.model_copy(update=expected)
    assert tremor.loop_delay_s == load_plan(bench).stages.tremor.loop_delay_s


def test_runs_that_decide_are_none_of_those_that_try(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """A remedy helps on the runs that try it and costs on others: it is reverted."""
    used: list[tuple[int, ...]] = []

    def measured(bench: BenchFile, seconds: float, seeds) -> TipError:
        used.append(tuple(seeds))
        has_remedy = bench.path.name == "bench-part.toml"
        away = {} if not has_remedy else {"8-12 Hz": -1.0 if seeds[0] == TRY_FROM else 1.0}
        return errors(away, count=len(seeds))

    def identify(lab: Lab) -> Path:
        file = tmp_path / "identified.toml"
        file.write_text("format = 1\n")
        return file

    monkeypatch.setattr("tools.heal.heal.tip_error", measured)
    part = Part("part", lambda lab: Comparison(1.0, "um"), identify)
    found = heal(MICRON, tmp_path, seconds=5.0, runs=3, name_effects=False, say=lambda text: None, parts=(part,))
    (step,) = found.steps
    assert not step.kept
    assert step.why == "the error 8-12 Hz rises by 1 um"
    assert found.bench is None
    assert sorted(p.name for p in tmp_path.iterdir()) == ["identified.toml"]
    assert len(set(used[0])) == VERIFY_RUNS * 3
    assert not set(used[0]) & set(used[1])


def concealed(tmp_path: Path, table: str) -> Path:
    text = MICRON.read_text().replace('"calibration/', f'"{MICRON.parent}/calibration/')
    file = tmp_path / "bench.toml"
    file.write_text(text.replace("[bus.daq0]", f"{table}\n\n[bus.daq0]", 1))
    return file


def lab_of(bench: Path, folder: Path) -> Lab:
    from sim_devices.config import emulation_config

    file = load_bench(bench)
    return Lab(file, emulation_config(file.description.model_dump()), folder)


@pytest.mark.parametrize(
    ("table", "compare", "factor"),
    [
        ("[emulation.stack]\nslip_sum = 0.62", compare_stacks, 1.5),
        ("[emulation.manipulator]\nmount_spread_deg = 2.0", compare_manipulator, 3.0),
        ("[emulation.sensors]\nmisalignment_deg = 1.5", compare_sensors, 3.0),
    ],
)
def test_each_part_shows_the_change_that_was_made_to_it(tmp_path: Path, table: str, compare, factor: float):
    before = compare(lab_of(MICRON, tmp_path / "a"))
    after = compare(lab_of(concealed(tmp_path, table), tmp_path / "b"))
    assert after.unit == before.unit
    assert after.rms > factor * before.rms


def test_the_horizon_of_the_estimator_follows_the_preview(tmp_path: Path):
    bench = load_bench(MICRON)
    file = tmp_path / "piezo.toml"
    text = (MICRON.parent / "calibration/piezo.toml").read_text()
    file.write_text(re.sub(r"^preview_s = .*$", "preview_s = 0.00102", text, flags=re.MULTILINE))
    healed = with_remedy(bench, file, tmp_path / "bench.toml")
    assert healed.description.firmware["tremor"]["loop_delay_s"] == pytest.approx(0.0019)
    assert healed.description.firmware["calibration"][-1] == str(file)


def test_a_real_bench_is_refused_without_max_effect_and_nothing_is_written(tmp_path: Path):
    text = (
        MICRON.read_text()
        .replace("sim://i2c0", "linux-i2c://1")
        .replace('"calibration/', f'"{MICRON.parent}/calibration/')
    )
    bench = tmp_path / "real.toml"
    bench.write_text(text)
    refusals = (([], "needs --max-effect 4"), (["3"], "needs --max-effect 4"), (["4"], "then micron calibrate piezo"))
    for effect, message in refusals:
        more = [o for e in effect for o in ("--max-effect", e)]
        result = CliRunner().invoke(app, ["mismatch", "heal", str(bench), "--out", str(tmp_path / "out"), *more])
        assert result.exit_code == 2
        assert message in " ".join(result.stderr.split())
        assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("bench", "message"),
    [
        ("nowhere.toml", "no such bench file"),
        ("endoscope", "has no tip that is compensated"),
        ("micron-can", "exactly one dac_amplifier"),
        (".", "is no regular file); name an existing bench file"),
    ],
)
def test_a_bench_that_cannot_be_healed_is_refused_and_nothing_is_written(tmp_path: Path, bench: str, message: str):
    result = CliRunner().invoke(app, ["mismatch", "heal", bench, "--out", str(tmp_path / "out")])
    assert result.exit_code == 2
    assert message in " ".join(result.stderr.split())
    assert not (tmp_path / "out").exists()


def test_what_has_no_remedy_is_said():
    step = Step("stacks", 0.2, "um", ("hysteresis", "thermal_drift"), ("thermal_drift",), True, "it falls", {})
    figures = dict.fromkeys((*BANDS, WHOLE), 1.0)
    said = lines(Healed("a", "b", (1, 2, 3), 12.0, figures, figures, (step,)))
    assert "  thermal drift: the firmware has no remedy." in said


def test_tip_error_is_the_same_for_the_same_seeds():
    bench = load_bench(MICRON)
    one, two = (tip_error(bench, 5.0, (7, 8)) for _ in range(2))
    for band in (*BANDS, WHOLE):
        np.testing.assert_array_equal(one.bands[band], two.bands[band])
