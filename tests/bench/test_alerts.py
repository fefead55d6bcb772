"""What the bench page says at once, from what the firmware told. No firmware, no socket."""

from __future__ import annotations

from pathlib import Path

from firmware_py.run.holds import OPERATOR
from tests.conftest import DEFAULT_BENCH
from tools.bench.firmware import Choice
from tools.bench.session import Session


def test_fallbacks_of_the_kinematics_are_said(tmp_path: Path):
    session = Session(Choice(DEFAULT_BENCH), tmp_path)

    def said() -> list[str]:
        return [alert["text"] for alert in session.alerts() if "Kinematics" in alert["text"]]

    session.run.phase, session.run.status = "running", {"t_s": 1.0, "lost": 0}
    assert said() == []
    session.run.status = {"t_s": 2.0, "lost": 0, "fallbacks": 0}
    assert said() == []
    session.run.status = {"t_s": 3.0, "lost": 0, "fallbacks": 7}
    assert said() == ["Kinematics: 7 ticks fell back to the other solution."]


def test_a_hold_says_its_cause_and_offers_to_resume_only_when_a_person_is_missing(tmp_path: Path):
    session = Session(Choice(DEFAULT_BENCH), tmp_path)

    def said(waits_for: str) -> list[dict[str, str]]:
        hold = {"cause": "daq: no new scan for 5 ms", "class": "link", "waits_for": waits_for, "rearm": "operator"}
        session.run.phase, session.run.status = "running", {"t_s": 1.0, "lost": 0, "hold": hold}
        return [alert for alert in session.alerts() if alert["text"].startswith("Hold")]

    text = "Hold, outputs at neutral: daq: no new scan for 5 ms."
    assert said("daq: no new scan for 5 ms") == [{"kind": "warn", "text": text}]
    waiting = {"kind": "warn", "text": f"{text} It waits for {OPERATOR}.", "order": "rearm"}
    assert said(OPERATOR) == [waiting]
    session.run.status["hold"] = None
    assert not [alert for alert in session.alerts() if alert["text"].startswith("Hold")]
