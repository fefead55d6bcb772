"""What is drawn, against signals whose answer is known."""

from dataclasses import replace

import numpy as np
import pytest

from tests.unit.mismatch_report.canned import missing_physics, pictures
from tools.mismatch.engine.report import DependsOn
from tools.mismatch.report import series


def test_runs_end_at_gaps_and_at_the_mask():
    t = np.array([0.0, 1.0, 2.0, 5.0, 6.0, 7.0, 8.0])
    mask = np.array([True, True, True, True, False, True, True])
    assert series.runs(mask, t) == [(0, 3), (3, 4), (5, 7)]
    assert series.runs(~mask, t) == [(4, 5)]


def test_an_envelope_keeps_every_extreme_and_breaks_at_gaps():
    t = np.concatenate([np.arange(5000), np.arange(6000, 11000)]) * 1e-3
    y = np.sin(t)
    y[1234] = 9.0
    y[7777] = -9.0
    x, z = series.envelope_line(t, y, columns=200)
    assert np.nanmax(z) == 9.0
    assert np.nanmin(z) == -9.0
    assert z.size < 600
    gap = np.nonzero(np.isnan(z))[0]
    assert gap.size == 2
    assert x[gap[0] - 1] <= t[4999] < t[5000] <= x[gap[0] + 1]
    assert np.all(np.diff(x[~np.isnan(x)]) > 0)


def test_a_short_line_is_left_alone():
    t = np.arange(50) * 0.1
    x, z = series.envelope_line(t, t**2)
    assert np.array_equal(x[:-1], t)
    assert np.array_equal(z[:-1], t**2)


def test_the_close_up_is_held_out_and_the_worst():
    p = pictures()
    bad = p.measured["displacement"].copy()
    rows = np.nonzero(p.held_out)[0]
    bad[rows[-10:]] += 5.0
    a, b = series.zoom(replace(p, measured={"displacement": bad}), "displacement")
    assert p.held_out[a:b].all()
    assert a <= rows[-1] < b


def test_autocorrelation_of_a_known_process():
    rng = np.random.default_rng(0)
    e = np.empty(40_000)
    e[0] = 0.0
    for i, w in enumerate(rng.normal(size=e.size - 1)):
        e[i + 1] = 0.8 * e[i] + w
    r, band = series.autocorrelation(e, [(0, 20_000), (20_000, 40_000)])
    assert r[:6] == pytest.approx(0.8 ** np.arange(6), abs=0.03)
    assert band == pytest.approx(1.96 / 200)


def test_spectrum_of_white_noise_is_its_density():
    e = np.random.default_rng(1).normal(0, 0.3, 60_000)
    f, density = series.spectrum(e, [(0, 30_000), (30_000, 60_000)], 1e-3)
    assert f[-1] == pytest.approx(500.0)
    # one-sided: variance = density^2 * half the sampling rate
    assert np.sqrt(np.mean(density[5:-5] ** 2)) == pytest.approx(0.3 * np.sqrt(2e-3), rel=0.02)


@pytest.mark.parametrize(
    ("feature", "label", "truth"),
    [
        ("value", "command", lambda u, t: u),
        ("rate", "rate of command", lambda u, t: np.gradient(u, t)),
        ("cross product", "command", lambda u, t: u),
    ],
)
def test_the_axis_is_what_the_residual_follows(feature: str, label: str, truth):
    t = np.arange(400) * 0.01
    p = replace(pictures(), t=t, signals={"command": np.sin(t)})
    name, x = series.axis_of(p, DependsOn("command", feature, 0.5))
    assert name == label
    assert x == pytest.approx(truth(np.sin(t), t))


def test_the_axis_can_be_time_or_nothing():
    p = pictures()
    assert series.axis_of(p, DependsOn("time", "time itself", 0.5))[1] is p.t
    assert series.axis_of(p, DependsOn("voltage_y", "value", 0.5)) is None
    assert series.axis_of(p, DependsOn("displacement", "value", 0.5))[1] is p.measured["displacement"]


def test_guilty_outputs_are_drawn_worst_first():
    r = missing_physics()
    two = {"a": 1.0, "displacement": 1.0, "b": 1.0, "c": 1.0}
    fit = replace(r.fit, unit=dict.fromkeys(two, "um"), noise_floor_rms=two)
    fit = replace(fit, recalibrated_rms={"a": 2.0, "displacement": 5.0, "b": 9.0, "c": 3.0})
    assert series.drawn_outputs(replace(r, fit=fit)) == ["displacement"]
    everywhere = replace(r.location, outputs=("a", "b", "c", "displacement"))
    assert series.drawn_outputs(replace(r, fit=fit, location=everywhere)) == ["b", "displacement", "c"]
    assert series.drawn_outputs(replace(r, fit=fit, location=replace(r.location, outputs=()))) == ["b"]


def test_binned_means_of_a_line():
    x = np.random.default_rng(2).permutation(np.linspace(-1, 1, 2000))
    at, mean = series.binned(x, 3 * x)
    assert mean == pytest.approx(3 * at, abs=1e-9)
    assert np.all(np.diff(at) > 0)


def test_an_axis_is_cut_only_for_what_lies_outside_the_held_out_data():
    e = np.random.default_rng(3).normal(size=5000)
    held = np.zeros(5000, bool)
    held[2000:3000] = True
    assert series.limit([e], held) is None
    e[:10] = 60.0
    assert series.limit([e, 0.1 * e], held) == pytest.approx(1.15 * np.max(np.abs(e[held])))
    e[2500] = 60.0
    assert series.limit([e], held) is None
    assert series.limit([e], np.zeros(5000, bool)) is None


def test_a_close_up_shows_a_few_cycles_whatever_the_noise():
    t = np.arange(6000) * 1e-3
    noisy = np.sign(np.sin(2 * np.pi * 2.0 * t)) + np.random.default_rng(4).normal(0, 0.3, t.size)
    p = replace(pictures(), t=t, held_out=np.ones(6000, bool), measured={"y": noisy}, recalibrated={"y": 0 * t})
    a, b = series.zoom(p, "y")
    assert b - a == pytest.approx(series.CYCLES * 500, rel=0.02)


@pytest.mark.parametrize(
    ("feature", "label"),
    [("value", "command (V)"), ("rate", "rate of command (V/s)"), ("frequency", "frequency of command (Hz)")],
)
def test_an_axis_has_its_unit(feature: str, label: str):
    p = replace(pictures(), units={"command": "V"})
    found = series.axis_of(p, DependsOn("command", feature, 0.5))
    assert found is not None
    assert found[0] == label
