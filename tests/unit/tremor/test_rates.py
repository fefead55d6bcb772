"""Estimators at 500 and 2000 Hz are designed for their rate: only the delay, and the limit with it, is another."""

from __future__ import annotations

import numpy as np
import pytest

from tests.unit.tremor.rates import figures

HANDS = (101, 102, 103)


@pytest.mark.parametrize("rate_hz", [500.0, 2000.0])
def test_a_hand_at_another_rate_is_followed(rate_hz: float) -> None:
    found = figures(rate_hz, HANDS[0])
    assert found.delay_ms == pytest.approx({500.0: 2.6, 2000.0: 1.85}[rate_hz])
    assert found.left_percent < 15.0
    assert figures(rate_hz, HANDS[0], designed_hz=1000.0).left_percent > 80.0


@pytest.mark.slow
@pytest.mark.parametrize("rate_hz", [500.0, 2000.0])
def test_what_is_left_beside_the_limit_is_that_of_1_khz(rate_hz: float) -> None:
    """Three hands of 30 s: noise is another at every rate, and one hand alone scatters by 3 %."""

    def ratio(hz: float) -> float:
        found = [figures(hz, seed, 30.0) for seed in HANDS]
        return float(np.mean([f.left_percent for f in found]) / np.mean([f.limit_percent for f in found]))

    assert ratio(rate_hz) == pytest.approx(ratio(1000.0), rel=0.02)
