"""The twin that watches on the bench page: its state, its alert, and the last minute as a recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from firmware_py.frame import LAYOUT, TIME
from hal.bench import load_bench
from tests.conftest import DEFAULT_BENCH
from tests.unit.mismatch_watch.test_live import STACK_TWIN
from tools.bench.firmware import Choice
from tools.bench.history import History
from tools.bench.twin_watch import TwinWatch
from tools.errors import InputError
from tools.mismatch.recording_load import load
from tools.mismatch.watch.live import Settings

STATUS = {"now_ns": 500_000_000, "t_s": 0.0}


def frames(seconds: float) -> np.ndarray:
    rng = np.random.default_rng(4)
    rows = np.zeros((round(seconds * 1000), LAYOUT.size))
    rows[:, TIME] = 0.001 * np.arange(len(rows))
    volts = 50.0 + 20.0 * np.sin(2 * np.pi * 1.3 * rows[:, TIME])
    rows[:, LAYOUT.start("command")] = volts
    rows[:, LAYOUT.start("stroke")] = 1e-6 * (0.125 * volts + 0.02 * rng.standard_normal(len(rows)))
    return rows


def watch(tmp_path: Path, text: str = STACK_TWIN) -> TwinWatch:
    (tmp_path / "twin.toml").write_text(text)
    beside = TwinWatch(Settings(tmp_path / "twin.toml", 15.0, 0.01))
    beside.begin(load_bench(DEFAULT_BENCH), Choice(DEFAULT_BENCH))
    return beside


def push(beside: TwinWatch, rows: np.ndarray) -> None:
    for k in range(0, len(rows), 2000):
        beside.take(STATUS, rows[k : k + 2000])


def test_a_change_is_an_alert_with_a_place(tmp_path: Path):
    beside, rows = watch(tmp_path), frames(26.0)
    rows[20_000:, LAYOUT.start("stroke")] += 1e-8
    push(beside, rows)
    live = beside._live  # pyright: ignore[reportPrivateUsage]
    assert live is not None
    found = live.close()
    assert found.alarms
    (alert,) = beside.alerts()
    assert alert[0] == "warn"
    assert alert[1].startswith("Reality leaves the twin: displacement, since about 20.")
    state = beside.state()
    assert state is not None
    assert state["counts"]["displacement"] >= 1


def test_the_last_minute_is_a_recording_of_the_same_twin(tmp_path: Path):
    beside, rows = watch(tmp_path), frames(70.0)
    history = History(LAYOUT)
    history.append(rows)
    push(beside, rows[:1000])
    folder = beside.write_last_minute(history, tmp_path / "last")
    beside.end()
    recording = load(folder)
    assert recording.n == pytest.approx(60_000, abs=2)
    assert recording.twin.kind == "piezo_stack"
    np.testing.assert_allclose(recording.inputs["command"], rows[-recording.n :, LAYOUT.start("command")], rtol=1e-6)


def test_without_a_twin_nothing_is_watched_and_the_button_says_so(tmp_path: Path):
    nothing = TwinWatch(None)
    nothing.begin(load_bench(DEFAULT_BENCH), Choice(DEFAULT_BENCH))
    nothing.take(STATUS, frames(0.1))
    assert nothing.state() is None
    assert nothing.alerts() == []
    with pytest.raises(InputError, match="--watch"):
        nothing.write_last_minute(History(LAYOUT), tmp_path / "last")


def test_a_twin_that_does_not_fit_another_bench_is_told_on_the_page(tmp_path: Path):
    beside = watch(tmp_path, STACK_TWIN.replace("stroke_1", "stroke_7"))
    ((kind, text),) = beside.alerts()
    assert kind == "warn"
    assert "no column 'stroke_7'" in text
    assert beside.state() == {"phase": "failed", "why": text.removeprefix("The twin does not watch: ")}
