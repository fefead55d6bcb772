"""What the bench page says at once, from what the firmware told. No firmware, no socket."""

from __future__ import annotations

from pathlib import Path

from tests.conftest import DEFAULT_BENCH
from tools.bench.firmware import Choice
from tools.bench.session import Session


def test_fallbacks_of_the_numeric_kinematics_are_said(tmp_path: Path):
    session = Session(Choice(DEFAULT_BENCH), tmp_path)

    def said() -> list[str]:
        return [alert["text"] for alert in session.alerts() if "kinematics" in alert["text"]]

    session.run.phase, session.run.status = "running", {"t_s": 1.0, "lost": 0}
    assert said() == []
    session.run.status = {"t_s": 2.0, "lost": 0, "fallbacks": 0}
    assert said() == []
    session.run.status = {"t_s": 3.0, "lost": 0, "fallbacks": 7}
    assert said() == ["Numeric kinematics: 7 ticks fell back to the analytic solution."]
