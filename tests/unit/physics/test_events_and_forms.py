"""Events read off the data, and forms of one effect that differ where a record tells them apart."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

from sim_devices.physics import hysteresis
from sim_devices.physics.catalogue import EFFECTS
from sim_devices.physics.dropped_samples import find_drops
from sim_devices.physics.effect import Context
from sim_devices.physics.hysteresis import loop_width
from sim_devices.physics.memory import stops
from sim_devices.physics.slew import SUBSTEPS, slew
from sim_devices.physics.step_shift import paying_steps

DT = 0.002


def context(n: int) -> Context:
    return Context(np.arange(n) * DT, DT, {}, "command")


@pytest.mark.parametrize("name", ["dead_time", "channel_delay"])
def test_a_played_back_signal_is_late_on_straight_lines(name: str) -> None:
    x = np.repeat([0.0, 1.0, -1.0, 0.5], 25)
    straight = EFFECTS[name].variants[0]
    assert straight.apply is not None
    late = straight.apply(x, context(x.size), np.array([0.4 * DT]), {})
    k = np.arange(x.size)
    np.testing.assert_allclose(late, np.interp(k - 0.4, k, x), atol=1e-12)
    names = [{p.name for p in e.parts({}).nonlinear} for e in (EFFECTS[name], straight)]
    assert names[0].isdisjoint(names[1])  # twin files tell the forms by these


def test_a_clock_that_runs_apart_on_straight_lines() -> None:
    x = np.random.default_rng(1).standard_normal(400)
    straight = EFFECTS["clock_skew"].variants[0]
    assert straight.apply is not None
    k = np.arange(x.size)
    found = straight.apply(x, context(x.size), np.array([500.0]), {})
    np.testing.assert_allclose(found, np.interp(k * (1 + 5e-4), k, x), atol=1e-12)


@pytest.mark.parametrize("colour", [0.0, 0.8])
def test_lost_samples_show_in_a_signal_without_bends(colour: float) -> None:
    rng = np.random.default_rng(3)
    n = 6000
    k = np.arange(n + 10)
    slow = np.sin(2 * np.pi * k / 1700) + 0.4 * np.sin(2 * np.pi * k / 640 + 1)
    at = (900, 2500, 4300)
    shift = np.searchsorted(at, k[:n], side="right")
    noise = rng.standard_normal(n)
    for i in range(1, n):
        noise[i] += colour * noise[i - 1]
    measured = slow[k[:n] + shift] + 0.0008 * noise / noise.std()
    found, total, share, _ = find_drops(slow[:n], measured)
    assert total == [1, 2, 3]
    assert np.max(np.abs(np.array(found) - at)) < 120
    assert share > 0.8


def test_steps_that_the_gain_explains_are_none() -> None:
    rng = np.random.default_rng(2)
    n = 4000
    signal = np.sin(2 * np.pi * np.arange(n) / 1300)
    residual = 0.4 * signal + 2.0 * (np.arange(n) >= 2500) + 0.5 * rng.standard_normal(n)
    keep = np.ones(n, bool)
    keep[1000:1200] = False
    assert paying_steps(residual, keep, [330, 650, 2500, 3300], signal) == [2500]


def test_one_slew_rate_holds_both_ways() -> None:
    effect = EFFECTS["slew_limit"]
    x = np.repeat([0.0, 1.0, 0.0], 200)
    assert effect.apply is not None
    y = effect.apply(x, context(x.size), np.array([5.0, 1e-6]), {})
    np.testing.assert_allclose(
        y, slew(x, (5.0 * DT / SUBSTEPS, 5.0 * DT / SUBSTEPS), 1.0, np.array([0]), SUBSTEPS, False), atol=1e-9
    )
    assert np.max(np.abs(np.diff(y))) == pytest.approx(5.0 * DT)


def test_a_line_has_no_loop_and_a_play_its_own() -> None:
    x = hysteresis.test_cycle(-1.0, 1.0)
    assert loop_width(x, 3) == pytest.approx(0.0, abs=1e-12)
    r = np.array([0.1])
    play = x - stops(x, r, -1.0, np.array([0]))[:, 0]
    # the branches of a play of radius r lie 2 r apart; its span is the input's less 2 r
    assert loop_width(play, 3) == pytest.approx(0.2 / 1.8, rel=1e-6)


def test_a_record_that_starts_at_an_extreme_has_elements_that_slip_once() -> None:
    effect = EFFECTS["hysteresis"]
    assert effect.basis is not None
    x = np.concatenate([np.linspace(1, -1, 300), np.linspace(-1, 1, 300), np.linspace(1, -1, 300)])
    settings = {"range": (-1.0, 1.0), "rest": (1.0,), "form": (0.0,), "wide": (1.0,)}
    assert hysteresis.slips_once(-1.0, 1.0, 1.0)
    assert not hysteresis.slips_once(-1.0, 1.0, 0.1)
    columns = effect.basis(x, context(x.size), np.empty(0), settings)
    # a Maxwell element of 1.5 half ranges: slips on the first way, sticks for ever after
    element = stops(x, np.array([1.5]), 1.0, np.array([0]))[:, 0]
    a = np.column_stack([np.ones(x.size), x, columns])
    left = element - a @ np.linalg.lstsq(a, element, rcond=None)[0]
    assert np.std(left) < 0.05 * np.std(element - np.polyval(np.polyfit(x, element, 1), x))


def test_memory_that_no_speed_changes_is_not_called_rate_dependent() -> None:
    limits = EFFECTS["rate_dependent_hysteresis"].limits
    settings = {"usual_slope": (1.0,), "rest": (0.0,), "range": (-1.0, 1.0), "time": (1e-3, 10.0)}
    effect = EFFECTS["rate_dependent_hysteresis"]
    parts = effect.parts(settings)
    p = np.zeros(1 + len(parts.weights))
    p[0], p[3] = 0.01, 0.1
    assert effect.report is not None
    low, high = limits["change_with_speed"]
    still = {h.name: h.value for h in effect.report(p, settings, 1.0)}["change_with_speed"]
    assert still < low
    p[13] = 0.1  # the weight that grows with speed
    assert low < {h.name: h.value for h in effect.report(p, settings, 1.0)}["change_with_speed"] < high
    lag = np.zeros(p.size)
    lag[0], lag[-1] = 0.01, 1.0
    assert {h.name: h.value for h in effect.report(lag, settings, 1.0)}["change_with_speed"] > high


def test_a_dead_zone_beside_zero_is_one_only_where_the_response_comes_back() -> None:
    effect = EFFECTS["dead_zone"]
    least, most = effect.limits["response_beyond"]

    def beyond(half_width: float, centre: float, lost: float, lo: float, hi: float) -> float:
        assert effect.report is not None
        found = effect.report(np.array((half_width, centre, lost), np.float64), {"range": (lo, hi)}, 1.0)
        return {h.name: h.value for h in found}["response_beyond"]

    assert beyond(0.2, 0.0, 1.0, -1.0, 1.0) == pytest.approx(0.4)
    assert beyond(0.2, 0.0, 1.0, 0.0, 1.0) == pytest.approx(0.8)  # a valve that opens one way
    assert beyond(0.1, 0.5, 1.0, -1.0, 1.0) == pytest.approx(0.2)
    assert least < 0.2 < most
    assert beyond(0.3, 0.9, 1.0, 0.0, 1.0) < least  # a limit at 0.6
    assert beyond(0.3, -0.9, 1.0, -1.0, 0.0) < least
    assert beyond(0.3, 0.9, 0.25, 0.0, 1.0) == pytest.approx(0.3)  # it goes on with three quarters of its slope


def test_a_smooth_drift_is_no_random_walk_and_a_walk_is_one() -> None:
    n = 4000
    rng = np.random.default_rng(12)
    t = np.arange(n) / n
    ctx = context(n)
    test = EFFECTS["random_walk"].test
    assert test is not None
    noise = 0.02 * rng.standard_normal(n)
    walk = np.cumsum(rng.standard_normal(n))
    assert test(t, walk / walk.std() + noise, ctx).p_value < 1e-7
    assert test(t, np.sin(2 * np.pi * 3 * t) + 0.5 * np.cos(2 * np.pi * 5.3 * t) + noise, ctx).p_value == 1.0


def test_a_walk_whose_slow_part_was_fitted_away_is_still_one() -> None:
    n = 4000
    rng = np.random.default_rng(12)
    walk = np.cumsum(rng.standard_normal(n))
    t = np.linspace(-1, 1, n)
    waves = np.column_stack([np.cos(np.pi * k * np.arange(n) / n) for k in range(14)])
    bent = walk - waves @ np.linalg.lstsq(waves, walk, rcond=None)[0]
    test = EFFECTS["random_walk"].test
    assert test is not None
    assert test(t, bent / bent.std() + 0.02 * rng.standard_normal(n), context(n)).p_value < 1e-3
    brief = np.convolve(rng.standard_normal(n), np.exp(-np.arange(60) / 12), "same")
    assert test(t, brief, context(n)).p_value == 1.0


def test_a_slew_limit_of_a_file_without_settings_is_reported() -> None:
    for effect in (EFFECTS["slew_limit"], *EFFECTS["slew_limit"].variants):
        assert effect.report is not None
        found = effect.report(np.array([3.0, 2.0, 0.1][: len(effect.parts({}).nonlinear)]), {}, 1.0)
        assert next(h.value for h in found if h.name == "rate_up") == 3.0


def test_a_line_in_recordings_shorter_than_two_windows_is_steady() -> None:
    n, every = 6000, 250  # windows of ten periods, of which every other one is kept
    t = np.arange(n) * DT
    swelling = (1.0 + t / 6.0) * np.sin(2 * np.pi * 20.0 * t)
    rest = swelling + 0.01 * np.random.default_rng(5).standard_normal(n)
    vibration = EFFECTS["vibration"].prepare
    assert vibration is not None
    knots = {}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name, mask in (("apart", np.arange(n) // every % 2 == 0), ("whole", None)):
            knots[name] = len(vibration(rest, rest, replace(context(n), mask=mask))["knots_s"])
    assert knots["apart"] == 1
    assert knots["whole"] > 1
