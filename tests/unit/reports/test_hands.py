"""Limits of one hand against tremor whose answer is known; the page's table and its verdict."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from firmware_py.actuation.config import ActuationConfig
from firmware_py.control.plan import load_plan
from firmware_py.frame import LAYOUT, TREMOR_AHEAD
from hal.bench import load_bench
from tests.conftest import DEFAULT_BENCH
from tools.closed_loop.simulate import SimulatedRun
from tools.reports.figures import BANDS_HZ, TREMOR_BAND_HZ, BandFigures, Spectrum, TremorFigures
from tools.research.reports.hand_limits import (
    ABOVE_HZ,
    BandParts,
    FineMotion,
    Swing,
    band_parts,
    band_rms_um,
    fine_motion,
    known_tremor_um,
    strongest,
)
from tools.research.reports.hands import HANDS, METHODS, UNSEEN, HandRow, draw_people, markdown, people_table

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


def test_the_strongest_stretch_of_a_swing() -> None:
    t_s = np.arange(20_000) / 1000.0
    size = np.where((t_s > 8.0) & (t_s < 11.0), 100e-6, 5e-6)
    tip = np.zeros((len(t_s), 3))
    tip[:, 2] = size * np.sin(2.0 * np.pi * 10.0 * t_s)
    truth = {"t_ns": 1e9 * t_s + 7e9, "tip_rigid_m": tip, "intended_m": np.zeros_like(tip)}
    found = strongest(truth, round(10e9), round(26e9))
    assert found.start_s == pytest.approx(8.0, abs=0.1)
    assert found.rms_um == pytest.approx(100.0 / np.sqrt(2.0), rel=0.05)
    assert found.share > 0.95
    # without the swing: nothing stands out
    assert strongest(truth, round(19e9), round(26e9)).share == pytest.approx(3.0 / 7.0, abs=0.05)


@pytest.mark.parametrize(
    ("share", "rest_um", "said"),
    [
        (0.93, 5.0, "93 % of the tremor's power is one swing from 14 to 17 s"),
        (0.3, 40.0, "hold 30 % of the tremor's power: no single swing"),
        (1.0, 0.0, "Wild: With the tremor known"),  # a run of 8 s: three are scored
    ],
)
def test_the_page_says_which_hands_miss_the_goal_and_why(share: float, rest_um: float, said: str) -> None:
    def row(hand: str, method: str, left_um: float) -> HandRow:
        vector = BandFigures(20.0, left_um, 100.0 * (1.0 - left_um / 20.0))
        figures = TremorFigures((8.0, 12.0), (5.0, 40.0), vector, {}, vector, dict.fromkeys(BANDS_HZ, vector), 1.0, 0.0)
        return HandRow(hand, "-", method, figures, 1.5, 4.0, 2.0, Swing(14.0, 3.0, share, 74.0, rest_um))

    page = markdown([row("calm", "adaptive", 4.0), row("calm", "kalman", 9.0), row("wild", "adaptive", 8.0)], 40.0, "x")
    assert "| calm | adaptive | 20.00 | 4.00 | 80.0 | 80.0, 90.0 | 1.5 |" in page
    assert "reached in 1 of 2 hands; not in: wild (60.0 %)." in page
    assert said in " ".join(page.split())
    assert "Wild:" in page
    assert "Calm:" not in page


def test_a_page_of_hands_that_all_reach_the_goal_explains_none() -> None:
    vector = BandFigures(20.0, 4.0, 80.0)
    figures = TremorFigures((8.0, 12.0), (5.0, 40.0), vector, {}, vector, dict.fromkeys(BANDS_HZ, vector), 1.0, 0.0)
    page = markdown(
        [HandRow("calm", "-", "adaptive", figures, 1.5, 4.0, 2.0, Swing(9.0, 3.0, 0.9, 74.0, 5.0))], 8.0, "x"
    )
    assert "reached in 1 of 1 hands." in page
    assert "swing" not in page


def test_the_page_has_the_spectrum_of_the_default_estimator_and_names_what_no_setting_has_seen() -> None:
    vector = BandFigures(20.0, 4.0, 80.0)
    spectrum = Spectrum((8.0, 10.0), (3.0, 12.0), (0.5, 1.25))
    bands = dict.fromkeys(BANDS_HZ, vector)
    figures = TremorFigures((8.0, 12.0), (5.0, 40.0), vector, {}, vector, bands, 1.0, 0.0, spectrum)
    swing = Swing(9.0, 3.0, 0.9, 74.0, 5.0)
    rows = [HandRow("a|b", "data.npz#305:365", method, figures, 1.5, 4.0, 2.0, swing) for method in METHODS]
    page = markdown(rows, 8.0, "x")
    assert "| a\\|b | - | - | - | 3.0 -> 0.500 | 12.0 -> 1.2 | - |" in page
    assert page.count("12.0 -> 1.2") == 1
    assert "No setting was chosen on the part that is scored: a|b (305:365 s)." in page


def test_above_the_band_a_known_tremor_within_the_strokes_leaves_the_hand_and_a_wrong_wish_adds_to_it() -> None:
    """A hand with a line at 9 Hz and one at 40 Hz; the estimator asks for 60 Hz that is not there."""
    t_s = np.arange(12_000) / 1000.0
    tip = np.zeros((len(t_s), 3))
    tip[:, 0] = 10e-6 * np.sin(2 * np.pi * 9.0 * t_s) + 1e-6 * np.sin(2 * np.pi * 40.0 * t_s)
    truth = {"tip_rigid_m": tip, "intended_m": np.zeros_like(tip), "tip_m": 3.0 * tip}
    frames = np.zeros((11_000, LAYOUT.size))
    frames[:, TREMOR_AHEAD + 1] = 2e-6 * np.sin(2 * np.pi * 60.0 * t_s[1000:])
    parts = band_parts(truth, frames, (t_s > 4.0) & (t_s < 11.0), np.eye(3), ActuationConfig())
    found, core = parts[ABOVE_HZ], parts[TREMOR_BAND_HZ]
    one = 1.0 / np.sqrt(2.0)
    assert found.hand_um == pytest.approx(one, rel=0.01)
    assert found.known_um == pytest.approx(one, rel=0.05)
    assert found.wish_um == pytest.approx(np.sqrt(5.0) * one, rel=0.01)
    assert found.tip_um == pytest.approx(3.0 * one, rel=0.01)
    assert core.hand_um == pytest.approx(10.0 * one, rel=0.01)
    assert core.known_um < 0.05 * core.hand_um  # 10 um fit every stroke
    assert core.wish_um == pytest.approx(10.0 * one, rel=0.01)
    assert core.tip_um == pytest.approx(30.0 * one, rel=0.01)


def test_the_page_says_what_is_added_above_the_band_and_what_room_the_strokes_leave() -> None:
    vector = BandFigures(20.0, 4.0, 80.0)
    bands = dict.fromkeys(BANDS_HZ, vector)
    figures = TremorFigures((8.0, 12.0), (5.0, 40.0), vector, {}, vector, bands, 1.0, 0.0)
    swing = Swing(9.0, 3.0, 0.9, 74.0, 5.0)
    rows = [
        HandRow(name, "-", "adaptive", figures, 1.5, 4.0, 2.0, swing, 30.0, above)
        for name, above in (("still", BandParts(3.0, 2.9, 3.1, 3.4)), ("wide", BandParts(0.9, 1.5, 1.5, 4.1)))
    ]
    page = markdown(rows, 8.0, "x")
    assert "| still | 3.00 | 3.40 | 1.60 | 0.00 | 2.00 | 0.78 | - | - | met |" in page
    assert "| wide | 0.90 | 4.10 | 4.00 | 1.20 | 1.60 | 1.20 | - | - | missed |" in page


def test_motion_above_the_band_is_judged_in_every_step_of_the_plant_and_synthetic_hands_stricter() -> None:
    vector = BandFigures(20.0, 4.0, 80.0)
    figures = TremorFigures((8.0, 12.0), (5.0, 40.0), vector, {}, vector, dict.fromkeys(BANDS_HZ, vector), 1.0, 0.0)
    swing, above = Swing(9.0, 3.0, 0.9, 74.0, 5.0), BandParts(0.0, 0.0, 0.5, 0.9)
    page = markdown(
        [
            HandRow(name, "-", "adaptive", figures, 1.5, 4.0, 2.0, swing, recorded_s, above, None, FineMotion(0.0, 1.5))
            for name, recorded_s in (("recorded", 30.0), ("synthetic", float("inf")))
        ],
        8.0,
        "x",
    )
    assert "| recorded | 0.00 | 0.90 | 0.90 | 0.00 | 2.00 | 0.50 | 0.00, 1.50 | 1.50 | met |" in page
    assert "| synthetic | 0.00 | 0.90 | 0.90 | 0.00 | 1.00 | 0.50 | 0.00, 1.50 | 1.50 | missed |" in page


def test_fine_motion_sees_a_resonance_that_samples_at_the_scan_do_not() -> None:
    """A line at 1000 Hz stands still for one sample a millisecond."""
    ms, steps = 4000, 32_000
    t_s = (1.0 + np.arange(steps)) / 8000.0
    fine = np.zeros((steps, 6))
    fine[:, 0] = 1e-6 * np.sin(2.0 * np.pi * 1000.0 * t_s)
    fine[:, 1] = fine[:, 4] = 3e-6 * np.sin(2.0 * np.pi * 40.0 * t_s)
    truth = {"t_ns": 1_000_000 * np.arange(ms + 1), "intended_m": np.zeros((ms + 1, 3))}
    run = SimulatedRun(truth, 0, 0, 0, 0, None, load_plan(load_bench(DEFAULT_BENCH)).stages, fine)
    found = fine_motion(run, 1_000_000_000, 3_000_000_000)
    assert found.hand_um == pytest.approx(3.0 / np.sqrt(2.0), rel=0.01)
    assert found.added_um == pytest.approx(1.0 / np.sqrt(2.0), rel=0.01)


def test_the_page_says_what_strokes_and_estimator_leave_of_the_tremor() -> None:
    vector = BandFigures(40.0, 18.0, 55.0)
    figures = TremorFigures((8.0, 12.0), (5.0, 40.0), vector, {}, vector, dict.fromkeys(BANDS_HZ, vector), 1.0, 0.0)
    swing, core = Swing(9.0, 3.0, 0.9, 74.0, 5.0), BandParts(40.0, 10.0, 7.5, 18.0)
    page = markdown([HandRow("wide", "-", "adaptive", figures, 1.5, 4.0, 2.0, swing, 30.0, None, core)], 8.0, "x")
    assert "| wide | 40.00 | 18.00 | 10.00 | 7.50 | 17.50 | 75.0 |" in page


def test_parts_that_no_setting_has_seen_are_of_hands_that_are_run() -> None:
    assert set(UNSEEN) <= {Path(source).name for _, source in HANDS}


def test_people_are_drawn_from_the_revision_and_summed_up_in_every_band() -> None:
    seeds = draw_people("abc", 3)
    assert seeds == draw_people("abc", 3) != draw_people("abd", 3)
    people = []
    for left_um in (1.0, 2.0, 6.0):
        band = BandFigures(20.0, left_um, 100.0 * (1.0 - left_um / 20.0))
        bands = dict.fromkeys(BANDS_HZ, band)
        figures = TremorFigures((8.0, 12.0), (5.0, 40.0), band, {}, band, bands, 1.0, 0.0)
        people.append((figures, FineMotion(0.3, 0.5 * left_um)))
    lines = people_table(people, seeds)
    assert "1.45 um in the mean, 2.98 um at worst, met in 2 of 3." in " ".join(lines)
    assert "| 8-12 Hz | 20.00 | 3.00 | 6.00 | 85.0 | 70.0 |" in lines
    assert "| 20-500 Hz | 20.00 | 3.00 | 6.00 | - | - |" in lines
    assert all(str(seed) in " ".join(lines) for seed in seeds)
