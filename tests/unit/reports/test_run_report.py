"""What the report of a run says in words: nothing that went wrong is left to the JSON."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from firmware_py.app import run_in_process
from firmware_py.run_request import RunRequest
from tests.conftest import DEFAULT_BENCH
from tools.cli.run import complete_result
from tools.reports.run_report import headline, summary_lines


@pytest.fixture(scope="module")
def sensed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    bench: Path = DEFAULT_BENCH
    return complete_result(*run_in_process(RunRequest(bench, 0.5, virtual=True, sense_only=True)))


def test_a_run_that_arms_nothing_says_so(sensed: dict[str, Any]):
    assert "Nothing was armed" in headline(sensed)
    assert not any(line.startswith("noticed") for line in summary_lines(sensed))


def test_what_was_noticed_and_caught_up_is_told(sensed: dict[str, Any]):
    told = {**sensed, "noticed": {"scans came late": 7, "parallel axes disagree": 9}}
    told["ticks"] = {**sensed["ticks"], "caught_up": 41}
    lines = summary_lines(told)
    assert "noticed: scans came late, parallel axes disagree" in lines
    assert any("41 caught up without a command of their own" in line for line in lines)
