"""Gross faults are said before physics is blamed."""

import numpy as np

from tools.mismatch.engine.checks import clipped_samples, lag_samples, messages

T = np.arange(4000) * 1e-3
X = np.sin(2 * np.pi * 1.3 * T) + 0.4 * np.sin(2 * np.pi * 3.1 * T)
Y = np.cos(2 * np.pi * 0.7 * T)


def said(output: np.ndarray, simulated: np.ndarray) -> str:
    return "; ".join(messages({"u": X}, {"y": output}, {}, {"y": simulated}, {"y": "u"}, 1e-3))


def test_nothing_to_say_about_a_good_match() -> None:
    rng = np.random.default_rng(0)
    assert said(X + 0.01 * rng.standard_normal(X.size), X) == ""


def test_sign_unit_shift_and_silence() -> None:
    assert "opposite sign" in said(-X, X)
    assert "1000" in said(1000 * X, X)
    assert "gravity" in said(9.81 * X, X)
    assert "degrees" in said(57.3 * X, X)
    assert "late" in said(np.roll(Y, 300), Y)
    assert "never changes" in said(np.zeros(4000), X)


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
