"""Bounds, cases and scores: against plain taps, against what is known of the signals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from firmware_py.tremor.adaptive_design import design_adaptive
from firmware_py.tremor.config import TremorConfig
from tools.errors import InputError
from tools.research.tremor.bound import lift, wiener_bounds
from tools.research.tremor.cases import case_of, cases_from, emulated_hand
from tools.research.tremor.published import band_passed, held, published_case, two_hundred_taps
from tools.research.tremor.scores import score
from tools.research.tremor.signal import TremorSignal

CONFIG = TremorConfig(sees="displacement", filter_cutoff_rad_s=float("inf"))


def signal_of(values: np.ndarray, quantity: str, unit: str, rate_hz: float = 100.0) -> TremorSignal:
    return TremorSignal("made", "made", "one", quantity, unit, ("x",), values[:, None], rate_hz, rate_hz)


def test_the_oracle_over_the_bank_is_that_of_plain_taps() -> None:
    """0.6 s of taps (means of 4 samples), fitted in the same way, leave no less than the bank does."""
    case = published_case(2, 5, 16.0)
    design = design_adaptive(CONFIG)
    bank = score(case, wiener_bounds([case], [8], CONFIG)[0].oracle[8], 8, design).lifted_percent
    y, x = (lift(v, design)[:, 0] for v in (case.samples, case.truth))
    total = np.concatenate([[0.0], np.cumsum(y)])
    at = np.arange(5000, len(y) - 1000, 5)
    taps = np.stack([(total[at + 1 - 4 * k] - total[at - 3 - 4 * k]) / 4.0 for k in range(150)], axis=1)
    weights, *_ = np.linalg.lstsq(taps, x[at + 8], rcond=1e-10)
    left = x[at + 8] - taps @ weights
    assert bank < 1.1 * 100.0 * np.std(left) / np.std(x[at + 8])


def test_others_are_never_trained_on_the_same_subject() -> None:
    case = published_case(2, 5, 8.0)
    assert wiener_bounds([case, case], [0], CONFIG)[0].others == {}
    # hands of other sets stand in, and only where there is nobody else
    far, near = published_case(2, 6, 8.0), published_case(2, 7, 8.0)
    alone = wiener_bounds([case], [0], CONFIG, [far])[0].others[0]
    np.testing.assert_array_equal(alone, wiener_bounds([case, far], [0], CONFIG)[0].others[0])
    with_far = wiener_bounds([case, near], [0], CONFIG, [far])[0].others[0]
    np.testing.assert_array_equal(with_far, wiener_bounds([case, near], [0], CONFIG)[0].others[0])


def test_the_oracle_learns_noise_by_heart_and_a_filter_that_has_not_seen_the_second_does_not() -> None:
    """Samples that know nothing of the tremor: any filter of them can only add to it."""
    case = published_case(1, 5, 16.0)
    blind = replace(case, samples=np.random.default_rng(1).standard_normal(case.samples.shape))
    (bounds,) = wiener_bounds([blind], [8], CONFIG)
    design = design_adaptive(CONFIG)
    oracle, unseen = (score(blind, x[8], 8, design).lifted_percent for x in (bounds.oracle, bounds.unseen))
    assert oracle < 99.0
    assert unseen > 100.0


def test_a_steady_tremor_is_no_secret_to_either() -> None:
    case = published_case(2, 5, 16.0)
    (bounds,) = wiener_bounds([case], [8], CONFIG)
    design = design_adaptive(CONFIG)
    oracle, unseen = (score(case, x[8], 8, design).lifted_percent for x in (bounds.oracle, bounds.unseen))
    assert oracle < unseen < 1.3 * oracle


def test_published_records_are_like_that_page_s() -> None:
    """algorithms.md, part A: figures that need no estimator, within a tenth."""
    alone, mixed = ([published_case(task, s) for s in range(201, 211)] for task in (1, 2))
    assert [held(alone, h) for h in (1, 8, 20)] == pytest.approx([6.2, 49.0, 115.5], rel=0.1)
    assert [band_passed(mixed, h) for h in (0, 8, 20)] == pytest.approx([45.9, 78.3, 130.5], rel=0.1)
    others = [published_case(2, s) for s in range(301, 321)]
    assert two_hundred_taps(mixed, others, 8) == pytest.approx(21.6, rel=0.1)


@pytest.mark.parametrize(
    ("quantity", "unit", "factor"), [("acceleration", "m/s^2", -((2 * np.pi * 9.0) ** 2)), ("displacement", "m", 1.0)]
)
def test_a_recorded_tone_becomes_its_displacement(quantity: str, unit: str, factor: float) -> None:
    t = np.arange(1200) / 100.0
    case = case_of(signal_of(factor * 1e-3 * np.sin(2 * np.pi * 9.0 * t), quantity, unit), scale=False, noise=False)
    middle = case.truth[3000:-3000, 0]
    assert np.std(middle) == pytest.approx(1e-3 / np.sqrt(2), rel=0.02)
    assert case.frequency_hz == pytest.approx(9.0, abs=0.02)
    scaled = case_of(signal_of(factor * np.sin(2 * np.pi * 9.0 * t), quantity, unit))
    assert np.std(scaled.truth[3000:-3000, 0]) == pytest.approx(50e-6 / (2 * np.sqrt(2)), rel=0.05)


def test_a_perfect_prediction_leaves_nothing_and_is_not_late() -> None:
    case = emulated_hand(3, 10.0)
    ticks = 4
    perfect = np.zeros_like(case.truth)
    perfect[:-ticks] = case.truth[ticks:]
    figures = score(case, perfect, ticks, design_adaptive(TremorConfig()))
    assert figures.all_percent < 1e-6
    late = score(case, case.truth, ticks, design_adaptive(TremorConfig()))
    assert late.delay_ms == pytest.approx(ticks, rel=0.1)


def test_what_is_no_motion_is_refused() -> None:
    with pytest.raises(InputError, match="no motion"):
        case_of(signal_of(np.ones(1000), "screen position", "pixel"))
    with pytest.raises(InputError, match="hand:SEED"):
        cases_from("hand:x")
