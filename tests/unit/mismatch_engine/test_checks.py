"""Gross faults are said before physics is blamed."""

import numpy as np

from tools.mismatch.engine.checks import clipped_samples, lag_samples, messages, repeated_samples

T = np.arange(4000) * 1e-3
X = np.sin(2 * np.pi * 1.3 * T) + 0.4 * np.sin(2 * np.pi * 3.1 * T)
Y = np.cos(2 * np.pi * 0.7 * T)


def said(output: np.ndarray, simulated: np.ndarray, unit: str = "") -> str:
    return "; ".join(messages({"u": X}, {"y": output}, {}, {"y": simulated}, {"y": "u"}, 1e-3, units={"y": unit}))


def test_nothing_to_say_about_a_good_match() -> None:
    rng = np.random.default_rng(0)
    assert said(X + 0.01 * rng.standard_normal(X.size), X) == ""


def test_sign_unit_shift_and_silence() -> None:
    assert "opposite sign" in said(-X, X)
    assert "1000" in said(1000 * X, X)
    assert "g or m/s^2" in said(9.81 * X, X)
    assert "degrees" in said(57.3 * X, X)
    assert "late" in said(np.roll(Y, 300), Y)
    assert "never changes" in said(np.zeros(4000), X)


def test_the_unit_that_a_column_is_likely_in() -> None:
    assert "is the column in deg, not in rad?" in said(57.3 * X, X, "rad")
    assert "is the column in rad, not in deg?" in said(X / 57.3, X, "deg")
    assert "is the column in rpm, not in rad/s?" in said(9.55 * X, X, "rad/s")
    assert "is the column in mm, not in m?" in said(1000 * X, X, "m")
    assert "is the column in kPa, not in bar?" in said(100 * X, X, "bar")
    # a simulation that the output does not follow; then a gain that no unit has
    assert "spreads 60 times as far" in said(60 * Y * np.std(X) / np.std(Y), X, "rad")
    assert "column" not in said(2.0 * Y, X, "rad") + said(1.3 * X, X, "rad") + said(30 * X, X, "rad")


def test_clipping_and_lag() -> None:
    assert clipped_samples(np.clip(X, -0.5, 0.5))[0] > 300
    assert clipped_samples(X) == (0, 0)
    white = np.random.default_rng(1).standard_normal(4000)
    assert lag_samples(np.roll(white, 7), white, 50) == 7
    held = X.copy()
    held[1001:2000:50] = held[1000:2000:50]
    assert "repeats" in said(held, X)


def test_swapped_axes() -> None:
    inputs = {"fx": X, "fy": Y}
    found = messages(inputs, {"vx": Y, "vy": X}, {}, {"vx": X, "vy": Y}, {"vx": "fx", "vy": "fy"}, 1e-3)
    assert any("swapped" in m for m in found)


def test_equal_neighbours_of_a_rounded_channel_are_no_lost_samples() -> None:
    rng = np.random.default_rng(3)
    y = np.round(30.0 * np.sin(np.arange(4000) / 800.0) + 0.05 * rng.standard_normal(4000), 2)
    assert np.sum(np.diff(y) == 0) > 100
    assert repeated_samples(y) == 0
    held = y + 1e-7 * rng.standard_normal(4000)
    held[1000:1040] = held[1000]
    assert repeated_samples(held) == 39
