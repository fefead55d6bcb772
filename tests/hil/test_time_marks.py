"""Nothing happens at 2^31, 2^32 and 2^53 ns on the bench clock: a run across a mark is the run from zero."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from firmware_py.app import run_in_process
from firmware_py.run_request import RunRequest
from tests.conftest import DEFAULT_BENCH

BEFORE_NS = 1_000_000_000  # the mark falls into the run proper


def run_from(start_ns: int) -> tuple[dict[str, Any], dict[str, Any]]:
    outcome, truth = run_in_process(RunRequest(DEFAULT_BENCH, 0.8, pace="virtual", clock_start_ns=start_ns))
    assert truth is not None
    return outcome, truth


@pytest.fixture(scope="module")
def from_zero() -> tuple[dict[str, Any], dict[str, Any]]:
    return run_from(0)


@pytest.mark.timeout(240)
@pytest.mark.parametrize("mark_ns", [2**31, 2**32, 2**53])
def test_a_run_across_a_mark_is_the_same_run(mark_ns: int, from_zero: tuple[dict[str, Any], dict[str, Any]]):
    expected, truth_from_zero = from_zero
    start_ns = mark_ns - BEFORE_NS
    outcome, truth = run_from(start_ns)
    assert truth["t_ns"][0] < mark_ns < truth["t_ns"][-1]
    np.testing.assert_array_equal(truth["t_ns"] - start_ns, truth_from_zero["t_ns"])
    np.testing.assert_array_equal(truth["tip_m"], truth_from_zero["tip_m"])
    np.testing.assert_array_equal(truth["amplifier_V"], truth_from_zero["amplifier_V"])
    for key in ("samples", "commands", "noticed", "warnings"):
        assert outcome[key] == expected[key]
    assert outcome["safe_state"]["reason"] == "run finished"
