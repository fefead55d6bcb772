"""Half an hour in virtual time, or as long as MICRON_LONG_S says (28800 is a shift): memory flat, counts exact."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_py.app import run_in_process
from firmware_py.run_request import RunRequest
from tests.conftest import DEFAULT_BENCH

SECONDS = float(os.environ.get("MICRON_LONG_S", "1800"))
GROWTH_MB = 2.0


def resident_mb() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


@pytest.mark.slow
@pytest.mark.timeout(0)
def test_a_long_run_is_like_a_short_one():
    memory: list[tuple[float, float]] = []

    def look(status: dict[str, Any]) -> None:
        memory.append((status["t_s"], resident_mb()))

    outcome, _ = run_in_process(RunRequest(DEFAULT_BENCH, SECONDS, virtual=True, truth_s=2.0), look)
    settled = [mb for t_s, mb in memory if t_s > min(20.0, SECONDS / 3.0)]
    assert max(settled) - settled[0] < GROWTH_MB
    safe, samples = outcome["safe_state"], outcome["samples"]
    assert safe["reason"] == "run finished"
    assert safe["reached"]
    assert samples["received"] == samples["expected"] == outcome["ticks"]["run"]
    assert samples["lost"] == 0
    assert outcome["commands"]["sent"] == round(SECONDS * 1000)
    assert outcome["ticks"]["skipped"] == 0
    assert outcome["noticed"] == {}
    gaps_s = np.diff([t_s for t_s, _ in memory])
    assert np.ptp(gaps_s) < 0.05  # the status still comes five times a second
