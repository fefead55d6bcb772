"""Limits of one hand against tremor whose answer is known; the page's table and its verdict."""

from __future__ import annotations

import numpy as np
import pytest

from firmware_py.actuation.config import ActuationConfig
from tools.reports.hand_limits import band_rms_um, known_tremor_um
from tools.reports.hands import HandRow, markdown
from tools.reports.tremor_figures import BandFigures, TremorFigures

T_S = np.arange(4000) / 1000.0
KEEP = (T_S > 1.0) & (T_S < 3.5)


def swinging(size_m: float) -> dict[str, np.ndarray]:
    """10 Hz along x of the body, which is y of the world."""
    tip = np.zeros((len(T_S), 3))
    tip[:, 1] = size_m * np.sin(2.0 * np.pi * 10.0 * T_S)
    return {"tip_rigid_m": tip, "intended_m": np.zeros_like(tip)}


def test_the_stroke_takes_nothing_from_a_small_tremor_and_most_from_a_large_one() -> None:
    body = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    small, large = (known_tremor_um(swinging(size), KEEP, body, ActuationConfig()) for size in (50e-6, 5e-3))
    assert small < 0.02 * 50.0
    assert large > 0.5 * 5000.0 / np.sqrt(2.0)


def test_band_rms_of_a_tone() -> None:
    assert band_rms_um(swinging(100e-6)["tip_rigid_m"], KEEP) == pytest.approx(100.0 / np.sqrt(2.0), rel=0.01)


def test_the_page_says_which_hands_miss_the_goal() -> None:
    def row(hand: str, method: str, left_um: float) -> HandRow:
        vector = BandFigures(20.0, left_um, 100.0 * (1.0 - left_um / 20.0))
        figures = TremorFigures((8.0, 12.0), (5.0, 40.0), vector, {}, vector, 1.0, 0.0)
        return HandRow(hand, "-", method, figures, 1.5, 4.0, 2.0)

    page = markdown([row("calm", "adaptive", 4.0), row("calm", "kalman", 9.0), row("wild", "adaptive", 8.0)], 40.0, "x")
    assert "| calm | adaptive | 20.00 | 4.00 | 80.0 | 80.0, 90.0 | 1.5 |" in page
    assert "reached in 1 of 2 hands; not in: wild (60.0 %)." in page
