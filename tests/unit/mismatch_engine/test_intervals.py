"""Intervals that hold: colour, few blocks, instants, one exponential, parameters that the data do not move."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import t as student

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_engine.cases import recording, wave
from tools.mismatch.engine.colour import Whitener, fit_whitener
from tools.mismatch.engine.evidence import holds_zero
from tools.mismatch.engine.found import human_values, physics_found, values_of_forms
from tools.mismatch.engine.intervals import few_blocks, uncertainty
from tools.mismatch.engine.pose import prepared
from tools.mismatch.engine.residual import residuals
from tools.mismatch.engine.screen import places
from tools.mismatch.engine.split import own_split
from tools.mismatch.engine.trial import extended
from tools.mismatch.infer import diagnose
from tools.numbers import rms

Array = np.ndarray


def stack(extra: Array, rate_hz: float = 100.0):
    """A stack with ``extra`` (n,) on top of what its command makes."""
    u = 50 + 30 * wave(np.random.default_rng(5), extra.size)
    parameters: dict[str, object] = {"gain_um_per_V": 0.125, "offset_um": 0.0}
    return recording("piezo_stack", {"command": u}, {"displacement": 0.125 * u + extra}, parameters, rate_hz=rate_hz)


def test_the_spectrum_of_a_whitener_has_the_power_of_what_it_was_fitted_to() -> None:
    e = lfilter([1.0], [1.0, -0.7], np.random.default_rng(1).standard_normal(20_000))
    found = fit_whitener(e)
    cycles = (np.arange(4096) + 0.5) / 4096 - 0.5
    assert float(np.mean(found.spectrum(cycles))) == pytest.approx(float(np.var(e)), rel=0.05)
    one = Whitener(1.0, np.array([0.7]))
    assert one.spectrum(np.array([0.0]))[0] == pytest.approx(1 / 0.3**2)


def test_a_parameter_thatfew_blocks_carry_has_students_interval() -> None:
    moved = np.zeros((48, 2))
    moved[:4, 0] = 1.0
    moved[:, 1] = 1.0
    wide = few_blocks(moved)
    np.testing.assert_allclose(wide, [student.ppf(0.975, 4) / 1.96, student.ppf(0.975, 48) / 1.96])


def test_slow_noise_widens_the_interval_of_a_level() -> None:
    rng = np.random.default_rng(4)
    white = rng.standard_normal(3000)
    slow = lfilter([1.0], [1.0, -0.95], white)
    half: dict[str, float] = {}
    for name, e in (("white", white / white.std()), ("slow", slow / slow.std())):
        problem, _, base = prepared(stack(0.02 * e), 0.3, 0, False)
        offset = [p.name for p in base.model.parameters].index("offset_um")
        half[name] = float(uncertainty(problem, base).deviations()[offset])
    # a mean of AR(1) noise: sqrt((1 + a) / (1 - a)) = 6.2 times as wide
    assert 3.5 < half["slow"] / half["white"] < 9.0


def test_an_interval_is_as_wide_around_the_value_of_another_form_that_fits_as_well() -> None:
    problem, _, base = prepared(stack(0.02 * np.random.default_rng(2).standard_normal(3000)), 0.3, 0, False)
    unsure, at = uncertainty(problem, base), [p.name for p in base.model.parameters].index("offset_um")
    alone = human_values(problem, base, unsure)["base"]["offset_um"]
    other = replace(base, theta=base.theta + 3.0 * np.eye(base.theta.size)[at])
    both = values_of_forms(problem, base, unsure, [other])["base"]["offset_um"]
    assert both.value == alone.value
    assert both.ci95 == pytest.approx((alone.ci95[0], alone.ci95[1] + 3.0))
    assert values_of_forms(problem, base, unsure, [])["base"]["offset_um"] == alone


def test_what_the_data_do_not_move_is_as_wide_as_its_bounds() -> None:
    problem, _, base = prepared(stack(0.02 * np.random.default_rng(2).standard_normal(3000)), 0.3, 0, False)
    place = places(problem, (EFFECTS["slew_limit"],), ())[0]
    placed = replace(place, settings={"rates": (1e3, 1e5), "time": (0.01,)})
    model, theta = extended(problem, base, placed)
    rate = next(i for i, p in enumerate(model.parameters) if p.name.endswith(".rate"))
    theta[rate] = 1e5  # above everything that the command does
    sd = float(uncertainty(problem, replace(base, model=model, theta=theta)).deviations()[rate])
    p = model.parameters[rate]
    assert 1.96 * sd == pytest.approx(0.5 * (p.hi - p.lo), rel=1e-3)


def test_of_two_figures_that_only_act_as_a_product_neither_is_certain() -> None:
    # a zone of 20 mV in which no sample is: the output moves by its width times the slope that it loses
    volts = 50 + 30 * wave(np.random.default_rng(5), 3000)
    volts += np.where(np.abs(volts - 50) < 0.02, np.copysign(0.05, volts - 50), 0.0)
    um = 0.125 * (volts - np.clip(volts - 50, -0.01, 0.01)) + 2e-4 * np.random.default_rng(6).standard_normal(3000)
    made = recording(
        "piezo_stack", {"command": volts}, {"displacement": um}, {"gain_um_per_V": 0.125, "offset_um": 0.0}
    )
    problem, _, base = prepared(made, 0.3, 0, False)
    placed = replace(places(problem, (EFFECTS["dead_zone"],), ())[0], settings={"range": (20.0, 80.0)})
    model, theta = extended(problem, base, placed)
    theta[:2] = problem.given
    theta[-3:] = 0.01, 50.0, 0.125
    fitted = replace(base, model=model, theta=theta, residual=residuals(problem, model, theta))
    unsure = uncertainty(problem, fitted)
    found = human_values(problem, fitted, unsure)[placed.label]
    assert found["half_width"].ci95 == pytest.approx((0.006, 27.0))  # its bounds
    assert holds_zero(found["slope_lost_inside"])
    assert unsure.chance_of_none(0, 2) < 1e-6


def test_the_instant_of_a_step_has_an_interval() -> None:
    n, at = 3000, 17.0
    rng = np.random.default_rng(8)
    t = np.arange(n) / 100.0
    problem, _, base = prepared(stack(0.1 * (t >= at) + 0.05 * rng.standard_normal(n)), 0.3, 0, False)
    place = places(problem, (EFFECTS["step_shift"],), ())[0]
    placed = replace(place, settings={"times_s": (at,), "time": (0.01, 30.0)})
    model, theta = extended(problem, base, placed)
    theta[-2:] = 0.005, 0.1
    fitted = replace(
        base, model=model, theta=theta, residual={"displacement": 0.05 * rng.standard_normal(problem.index.size)}
    )
    low, high = human_values(problem, fitted, uncertainty(problem, fitted))[placed.label]["time1_s"].ci95
    # two samples and eleven times (0.05 / 0.1)^2, 10 ms each, either way
    assert 0.5 * (high - low) == pytest.approx(0.0475 + 0.0025, abs=0.02)


def test_what_is_left_without_an_effect_is_at_most_what_the_base_leaves(monkeypatch: pytest.MonkeyPatch) -> None:
    e = np.random.default_rng(8).standard_normal(3000)
    problem, _, base = prepared(stack(0.1 * (np.arange(3000) >= 1700) + 0.05 * e), 0.3, 0, False)
    place = places(problem, (EFFECTS["step_shift"],), ())[0]
    model, theta = extended(problem, base, replace(place, settings={"times_s": (17.0,), "time": (0.01, 30.0)}))
    theta[-2:] = 0.005, 0.1
    fitted = replace(base, model=model, theta=theta)
    poor = replace(base, cost=10.0 * base.cost, residual={"displacement": 3.0 * base.residual["displacement"]})
    monkeypatch.setattr("tools.mismatch.engine.found.reduced", lambda *_: poor)
    one = physics_found(problem, base, fitted, {}, {"step_shift": 0.9})[0]
    assert one.residual_rms_before == pytest.approx(rms(base.residual["displacement"][problem.held_rows]))


def test_a_fit_part_has_some_of_what_is_seldom() -> None:
    n = 6000
    x = 0.1 * np.random.default_rng(3).standard_normal((n, 1))
    for a in range(300, n, 1000):
        x[a : a + 40] += 5.0
    split = own_split(x)
    seldom = x[:, 0] > 2.0
    share = float((seldom & split.held_out_mask()).sum() / seldom.sum())
    assert 0.1 < share < 0.6


def test_a_delay_before_a_coarse_grid_has_an_interval_that_is_no_point() -> None:
    rate_hz, delay_s, step = 100.0, 0.013, 0.1
    u = 50 + 30 * wave(np.random.default_rng(5), 3000)
    t = np.arange(u.size) / rate_hz
    y = np.round(0.125 * np.interp(t - delay_s, t, u) / step) * step
    parameters: dict[str, object] = {"gain_um_per_V": 0.125, "offset_um": 0.0}
    rec = recording("piezo_stack", {"command": u}, {"displacement": y}, parameters, rate_hz=rate_hz)
    found = {p.name: p.parameters for p in diagnose(rec, jobs=1).physics}
    delay = found["dead_time"]["delay_s"]
    assert delay.ci95[0] < delay_s < delay.ci95[1]
    assert 1e-6 < delay.ci95[1] - delay.ci95[0] < 0.1 / rate_hz
