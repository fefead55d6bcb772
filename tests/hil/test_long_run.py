"""Half an hour in virtual time (MICRON_LONG_S), and a shift of eight hours without wires (MICRON_SHIFT_S): what
``micron soak`` asks of both. ``docs/results/long-runs.json`` has the figures.
"""

from __future__ import annotations

import os

import pytest

from tests.conftest import DEFAULT_BENCH
from tools.research.faults.long_run import LongRun, with_wires, without_wires

LONG_S = float(os.environ.get("MICRON_LONG_S", "1800"))
SHIFT_S = float(os.environ.get("MICRON_SHIFT_S", "28800"))


@pytest.mark.slow
@pytest.mark.timeout(0)
def test_a_long_run_is_like_a_short_one() -> None:
    """Across 2^53 ns of bench time in its middle."""
    run = with_wires(DEFAULT_BENCH, LONG_S, start_ns=2**53 - round(LONG_S * 0.5e9))
    print(run.as_dict())
    assert run.problems() == []
    assert run.marks == ["2^53"]
    assert run.counters["samples received"] == run.counters["ticks run"]
    assert run.counters["commands sent"] == round(LONG_S * 1000)


@pytest.mark.slow
@pytest.mark.timeout(0)
def test_the_last_hour_of_a_shift_is_like_the_first() -> None:
    run = without_wires(DEFAULT_BENCH, SHIFT_S)
    print(run.as_dict())
    assert run.problems() == []
    assert run.counters["ticks run"] >= SHIFT_S * 1000
    assert run.tilt_mrad is not None
    assert run.tilt_mrad[-1] < 1.5 * sorted(run.tilt_mrad)[len(run.tilt_mrad) // 2]  # the attitude does not run away


def run_of(**changes: object) -> LongRun:
    table: dict[str, object] = {
        "wires": True, "seconds": 80.0, "start_ns": 0, "cpu_s": 1.0, "left_um": [2.0] * 8, "tremor_um": [20.0] * 8,
        "tilt_mrad": None, "memory_MB": [100.0] * 8, "scatter": 0.02, "marks": [], "counters": {"samples lost": 0},
        "ended": "run finished",
    }  # fmt: skip
    return LongRun(**{**table, **changes})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"memory_MB": [100.0] * 7 + [103.0]}, "memory grew by 3.0 MB"),
        ({"left_um": [2.0] * 7 + [3.0]}, "varied by 50 %"),
        ({"tremor_um": [20.0] * 7 + [0.0]}, "nothing was seen in 1 of 8 eighths"),
        ({"counters": {"samples lost": 2}}, "samples lost: 2"),
        ({"ended": "daq: gone"}, "it ended with: daq: gone"),
    ],
)
def test_what_a_long_run_must_not_show_is_found(changes: dict[str, object], says: str) -> None:
    assert run_of().problems() == []
    (found,) = run_of(**changes).problems()
    assert says in found
