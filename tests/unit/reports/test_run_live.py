"""``micron run`` shows nothing wider than 80 columns before and while it runs, and the tremor that is there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hal.bench import load_bench
from hal.clock import Pace
from tests.conftest import DEFAULT_BENCH
from tools.cli.common import Exit
from tools.cli.run import RearmKey, exit_status
from tools.reports.run_live import LOOK_NS, TipWatch, live_line, opening_lines

BENCHES = sorted(DEFAULT_BENCH.parent.glob("micron*.toml"))


@pytest.mark.parametrize("pace", ["paced", "virtual", "realtime"])
@pytest.mark.parametrize("bench", BENCHES, ids=lambda path: path.stem)
def test_the_opening_says_what_runs_in_eighty_columns(bench: Path, pace: Pace) -> None:
    lines = opening_lines(load_bench(bench), 10.0, pace, "a/very/long/path/" * 8 + "hand.csv", 7)
    assert max(map(len, lines)) <= 80
    text = "\n".join(lines)
    assert "emulated devices" in text
    assert "10 s" in text
    assert ("wall clock" in text) == (pace == "realtime")


def status(**more: Any) -> dict[str, Any]:
    return {"t_s": 4.2, "state": "running", "lost": 0, "amplitude_um": [3.0, 4.0, 12.0], **more}


def test_the_line_shows_the_estimate_until_the_truth_is_known() -> None:
    watch = TipWatch()
    assert "tremor estimated  13.0 um" in live_line(status(), 10.0, watch)
    t_s = np.arange(0.0, 5.0, LOOK_NS * 1e-9)
    for t in t_s:
        tremor_m = 1e-6 * np.sin(2 * np.pi * 10.0 * t)
        watch.add(np.array([20.0 * tremor_m, 0.0, 0.0, 2.0 * tremor_m, 0.0, 0.0]) + 1e-3)
    rms = watch.rms_um()
    assert rms is not None
    assert rms == pytest.approx((20.0 / np.sqrt(2), 2.0 / np.sqrt(2)), rel=0.05)
    line = live_line(status(holds=1), 10.0, watch)
    assert f"{rms[0]:.1f} um without" in line
    assert f"{rms[1]:.1f} with" in line
    assert "holds 1" in line
    assert "6 s left" in line
    assert len(line) <= 80


def test_lost_scans_are_shown_at_once() -> None:
    assert "LOST 3" in live_line(status(lost=3), 10.0, TipWatch())


def safe_state(
    finding: str, cause: str, *, normal: bool = False, reached: bool = True, reason: str = "x"
) -> dict[str, Any]:
    return {"normal": normal, "reached": reached, "finding": finding, "reason": reason, "class": cause}


@pytest.mark.parametrize(
    ("safe", "lost", "code"),
    [
        (safe_state("finished", "operator", normal=True), 0, 0),
        (safe_state("finished", "operator", normal=True), 2, 3),
        (safe_state("stopped", "operator", normal=True, reason="stopped (SIGINT)"), 0, 130),
        (safe_state("stopped", "operator", normal=True, reason="stopped (SIGTERM)"), 0, 0),
        (safe_state("host_overslept", "host"), 0, 5),
        (safe_state("host_overslept", "host", reached=False), 0, 1),
        (safe_state("scans_missing", "link"), 9, 1),
    ],
)
def test_exit_status_says_whose_fault_it_was(safe: dict[str, Any], lost: int, code: int) -> None:
    assert exit_status({"safe_state": safe, "samples": {"lost": lost}, "recorder": {"dropped": 0}}) == Exit(code)


@pytest.mark.parametrize("rearm", ["automatic", "operator"])
def test_a_hold_is_shown_with_its_cause_and_the_key_that_ends_it(rearm: str) -> None:
    hold = {"cause": "daq: no new scan for 5 ms; check its link", "class": "link", "for_s": 0.3, "rearm": rearm}
    line = live_line(status(hold=hold, holds=1), 10.0, TipWatch())
    assert "no new scan" in line
    assert ("Enter resumes" in line) == (rearm == "operator")
    assert len(line) <= 80


def test_enter_counts_only_while_a_hold_waits_for_the_operator(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", None)
    pressed: list[int] = []
    key = RearmKey(lambda: pressed.append(1))
    for hold, count in ((None, 0), ({"rearm": "automatic"}, 0), ({"rearm": "operator"}, 1), (None, 1)):
        key.look({"hold": hold})
        key.press()
        assert len(pressed) == count
