"""The answer does not depend on how many processes found it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.unit.mismatch_report.systems import recording
from tools.mismatch.engine import workers
from tools.mismatch.infer import diagnose
from tools.mismatch.recording_load import load


@pytest.mark.slow
def test_one_and_two_processes_say_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def dead_zone(u: np.ndarray, t: np.ndarray) -> np.ndarray:
        return 0.125 * (u - np.clip(u - 50, -4, 4)) - 1.0

    rec = load(recording(tmp_path, change=dead_zone))
    monkeypatch.setattr(workers, "LEAST_WORK", 0)
    monkeypatch.setattr(workers, "LEAST_SAMPLES", 0)
    reports = [diagnose(rec, jobs=jobs).to_json() for jobs in (1, 2)]
    for report in reports:
        report["seconds"] = 0.0
    first, second = (json.dumps(r, sort_keys=True, default=float) for r in reports)
    assert reports[0]["verdict"] == "missing_physics"
    assert first == second
