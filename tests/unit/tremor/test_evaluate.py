"""``micron tremor evaluate``: rows, summaries against hand-made results, bad input."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from firmware_py.tremor.config import TremorConfig
from tests.command import micron
from tools.research.tremor.cases import emulated_hand
from tools.research.tremor.evaluate import ORACLE, OTHERS, Result, evaluate, summarise
from tools.research.tremor.manners import manners
from tools.research.tremor.scores import Score


def result(case: str, method: str, lifted: float) -> Result:
    return Result("g", case, case, method, 2, Score(50.0, 40.0, lifted, 0.0, 0.0), 10.0, 0.1, 1.0)


def test_ratios_are_those_of_mean_residuals() -> None:
    rows = [result("a", OTHERS, 20.0), result("a", ORACLE, 10.0), result("a", "flc", 22.0), result("b", "flc", 38.0)]
    line = next(s for s in summarise(rows) if s.method == "flc")
    assert (line.lifted_percent, line.worst_lifted_percent, line.cases) == (30.0, 38.0, 2)
    assert (line.to_others, line.to_oracle) == (1.5, 3.0)


def test_the_adaptive_filter_is_within_its_limit_on_hands_it_has_not_seen() -> None:
    """Seeds that no setting was tuned on, at the loop's horizon: 1.15 times the best filter of other hands."""
    lines = summarise(evaluate([emulated_hand(seed, 16.0) for seed in (111, 112)], ("adaptive", "wflc_flc"), (2,)))
    best = next(s for s in lines if s.method == "adaptive")
    assert best.to_others < 1.15
    assert best.lifted_percent < next(s for s in lines if s.method == "wflc_flc").lifted_percent
    assert abs(best.slow_percent) < 1.0
    assert abs(best.delay_ms) < 1.0


def test_onset_jump_and_bias() -> None:
    found = manners(["adaptive"], TremorConfig())[0]
    assert found.onset_s < 1.0
    assert found.jump_s < 1.0
    assert found.drift_share < 1.2
    assert found.drift_frequency_error_hz < 0.1


def test_a_csv_in_micrometres(tmp_path: Path) -> None:
    t = np.arange(1000) / 100.0
    x = 40.0 * np.sin(2 * np.pi * 9.0 * t)
    file = tmp_path / "hand.csv"
    file.write_text("t_s,x_um\n" + "\n".join(f"{a:.3f},{b:.4f}" for a, b in zip(t, x, strict=True)) + "\n")
    out, picture = tmp_path / "out.json", tmp_path / "out.png"
    arguments = ["tremor", "evaluate", str(file), "--method", "adaptive", "--horizons-ms", "2", "--json", str(out)]
    done = micron(*arguments, "--png", picture)
    assert done.exit_code == 0, done.output
    row = next(r for r in json.loads(out.read_text())["rows"] if r["method"] == "adaptive")
    assert row["lifted_percent"] < 15.0
    assert row["frequency_error_hz"] < 0.1
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["hand:1", "--method", "guess"], "no estimator"),
        (["hand:1", "--horizons-ms", "2;8"], "whole milliseconds"),
        (["nowhere.csv"], "no such file"),
        (["nowhere.mcap"], "no such recording"),
    ],
)
def test_bad_input_is_one_line_and_status_two(arguments: list[str], said: str) -> None:
    done = micron("tremor", "evaluate", *arguments)
    assert done.exit_code == 2
    assert said in done.output
