"""A run that arms nothing: an instrument turned by hand, which an armed run takes for two sensors that disagree."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from firmware_py.app import run_in_process
from firmware_py.run_request import RunRequest
from tests.conftest import copy_of_default_bench


@pytest.fixture
def turned(tmp_path: Path) -> Path:
    hand = '[emulation.hand]\nperforms = "poses"\nreach_s = [0.9, 0.9]\nhold_s = [0, 0]\n'
    return copy_of_default_bench(tmp_path, hand)


def test_turned_by_hand(turned: Path):
    armed, _ = run_in_process(RunRequest(turned, 3.0, pace="virtual"))
    assert "disagree" in armed["safe_state"]["reason"]
    assert armed["commands"]["sent"] > 0
    sensed, truth = run_in_process(RunRequest(turned, 3.0, pace="virtual", sense_only=True))
    assert sensed["safe_state"]["normal"]
    assert sensed["noticed"].keys() >= {"parallel axes disagree"}
    assert (sensed["commands"]["sent"], sensed["armed_ns"]) == (0, None)
    assert sensed["samples"]["lost"] == 0
    assert truth is not None
    assert np.ptp(truth["amplifier_V"], axis=0).max() < 1e-6
