"""What an estimator leaves of a stretch after more or less time with the hand."""

from __future__ import annotations

from dataclasses import replace

import pytest

from firmware_py.tremor.config import TremorConfig
from tools.research.tremor.adapting import LEADS_S, adapting
from tools.research.tremor.cases import RATE_HZ, emulated_hand


def test_a_hand_is_known_better_after_a_while_and_short_records_are_left_out() -> None:
    hand = emulated_hand(31, 26.0)
    begin = slice(round(20.0 * RATE_HZ))
    slow = None if hand.slow is None else hand.slow[begin]
    shorter = replace(hand, samples=hand.samples[begin], truth=hand.truth[begin], slow=slow)
    found = adapting([hand, shorter], 2)
    (ratios,) = found.values()
    assert len(ratios) == len(LEADS_S)
    assert ratios[-1] == 1.0
    assert ratios[0] > 1.0
    # without learning every lead beyond the run-in leaves the same
    still = TremorConfig().model_copy(
        update={"adaptive": TremorConfig().adaptive.model_copy(update={"prior_s": 1e9, "burst_prior_s": 1e9})}
    )
    (same,) = adapting([hand], 2, still).values()
    assert same[2] == pytest.approx(1.0, abs=1e-3)
