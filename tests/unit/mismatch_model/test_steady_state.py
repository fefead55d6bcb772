"""Records that repeat from the first sample on: the start state follows from the period, in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_engine.cases import recording
from tools.mismatch.recording import Recording
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_sites import sites
from tools.mismatch.simulate_start import prepare
from tools.mismatch.simulate_view import View
from tools.mismatch.steady import steady_period
from tools.mismatch.twins.make import make

RATE = 100.0
PERIOD = 80
CUBIC = 30.0
MATRICES = {"A": [[0.0, 1.0, 0.0], [-40.0, -0.3, 0.0], [0.0, 0.0, -0.2]],
            "B": [[0.0], [40.0], [1.0]], "C": [[1.0, 0.0, 2.0]], "D": [[0.1]], "hold": "zero"}  # fmt: skip


def tones(periods: float) -> np.ndarray:
    k = np.arange(round(PERIOD * periods))
    return 1.0 + np.sin(2 * np.pi * k / PERIOD) + 0.4 * np.cos(2 * np.pi * 5 * k / PERIOD + 0.7)


def steady_response(u: np.ndarray) -> np.ndarray:
    """By the transfer function of the difference equation at every line of the spectrum of one period."""
    a, b, c = (np.array(MATRICES[key]) for key in "ABC")
    poles, vectors = np.linalg.eig(a)
    ad = (vectors * np.exp(poles / RATE)) @ np.linalg.inv(vectors)
    bd = np.linalg.solve(a, (ad - np.eye(3)) @ b)
    spectrum = np.fft.fft(u[:PERIOD])
    gain = [
        (c @ np.linalg.solve(z * np.eye(3) - ad, bd))[0, 0] + MATRICES["D"][0][0]  # type: ignore[index]
        for z in np.exp(2j * np.pi * np.arange(PERIOD) / PERIOD)
    ]
    one = np.fft.ifft(np.array(gain) * spectrum).real
    return np.resize(one, u.size)


def made(u: np.ndarray, y: np.ndarray, segments: tuple[int, ...] = ()) -> Recording:
    rec = recording("state_space", {"u": u}, {"y": y}, dict(MATRICES), rate_hz=RATE)
    return replace(rec, segments=segments)


def test_a_state_space_twin_begins_in_steady_state() -> None:
    """Its slowest mode lives for 500 samples, so that three periods do not forget the start."""
    u = tones(3.5)
    y = steady_response(u)
    noisy = y + 1e-3 * np.random.default_rng(0).standard_normal(y.size)
    rec = made(u, noisy)
    model = Model(make(rec))
    found = model.simulate(View.whole(rec), model.start(rec))["y"]
    np.testing.assert_allclose(found, y, atol=1e-8)


def test_its_columns_add_up_to_the_same() -> None:
    u = tones(3)
    y = steady_response(u)
    rec = made(u, y)
    model = Model(make(rec))
    theta = model.start(rec)
    view = View(rec, ((0, rec.n),), 0, fit=((30, 100), (120, 240)))
    design = model.design(view, theta)
    total = design.constant["y"] + design.columns["y"] @ theta[list(design.linear["y"])]
    np.testing.assert_allclose(total, y, atol=1e-8)


def test_several_realisations_each_begin_in_their_own_steady_state() -> None:
    first, second = tones(3), 2.0 - np.roll(tones(4), 13)
    u = np.concatenate([first, second])
    y = np.concatenate([steady_response(first), steady_response(second)])
    rec = made(u, y, segments=(first.size,))
    model = Model(make(rec))
    np.testing.assert_allclose(model.simulate(View.whole(rec), model.start(rec))["y"], y, atol=1e-8)


def test_segments_of_a_record_without_periods_have_starts_of_their_own() -> None:
    rng = np.random.default_rng(1)
    u = rng.standard_normal(600)
    ones = recording("state_space", {"u": u[:300]}, {"y": u[:300]}, MATRICES | {"x0": [1.0, 0.0, 0.5]}, rate_hz=RATE)
    twos = recording("state_space", {"u": u[300:]}, {"y": u[:300]}, MATRICES | {"x0": [-2.0, 9.0, 0.1]}, rate_hz=RATE)
    runs = [Model(make(r)).simulate(View.whole(r), Model(make(r)).start(r))["y"] for r in (ones, twos)]
    rec = made(u, np.concatenate(runs), segments=(300,))
    model = Model(make(rec))
    view = View(rec, ((0, 600),), 0, fit=((0, 600),))
    np.testing.assert_allclose(model.residual(view, model.start(rec))["y"], 0.0, atol=1e-5)


def test_a_twin_of_equations_begins_in_steady_state() -> None:
    """v' = -v + u with u = sin w t, linear between samples: amplitude and phase by the transfer function."""
    n, w = 240, 2 * np.pi * RATE / PERIOD
    t = np.arange(n) / RATE
    text = {"states": {"v": {"unit": "1"}}, "equations": {"v": "u - rate*v"}, "outputs": {"y": "v"}, "rate": 9.0}
    y = np.imag(np.exp(1j * w * t) / (1j * w + 9.0))
    rec = recording("ode", {"u": np.sin(w * t)}, {"y": y}, text, rate_hz=RATE)
    model = Model(make(rec))
    found = model.simulate(View.whole(rec), model.start(rec))["y"]
    # straight lines between samples are lower than the sine by (w dt)^2 / 12
    np.testing.assert_allclose(found, y * (1 - (w / RATE) ** 2 / 12), atol=2e-4 * np.max(np.abs(y)))


@pytest.mark.parametrize("case", ["transient", "two periods short", "drifts", "input differs"])
def test_what_does_not_repeat_is_not_taken_for_steady(case: str) -> None:
    u = tones(1.9 if case == "two periods short" else 3)
    y = steady_response(u)
    if case == "transient":
        y = y + 0.3 * np.exp(-np.arange(y.size) / 40)
    if case == "drifts":
        y = y + 2e-4 * np.arange(y.size)
    if case == "input differs":
        u = u + 0.02 * np.random.default_rng(0).standard_normal(u.size)
    assert steady_period({"u": u}, {"y": y}) == 0


def test_noise_does_not_hide_the_steady_state() -> None:
    u = tones(4)
    y = steady_response(u)
    y = y + 0.02 * np.std(y) * np.random.default_rng(2).standard_normal(y.size)
    assert steady_period({"u": u}, {"y": y}) % PERIOD == 0
    assert steady_period({"u": u}, {"y": y}) > 0


def test_a_force_in_the_loop_is_shot_to_where_it_repeats() -> None:
    """A hardening spring beside a linear one: a run of forty periods from rest ends where shooting begins."""
    matrices = {"A": [[0.0, 1.0], [-100.0, -4.0]], "B": [[0.0], [1.0]], "C": [[1.0, 0.0]], "hold": "zero"}
    u = 60.0 * np.resize(tones(1) - 1.0, 40 * PERIOD)

    def run(v: np.ndarray, y: np.ndarray, parameters: dict[str, object]) -> np.ndarray:
        rec = recording("state_space", {"u": v}, {"y": y}, parameters, rate_hz=RATE)
        twin = make(rec)
        place = next(p for p in sites(twin, rec, EFFECTS["cubic_stiffness"]) if p.site == "feedback")
        base = Model(twin)
        model = Model(twin, [prepare(base, View.whole(rec), base.start(rec), place)])
        theta = model.start(rec)
        theta[[p.name for p in model.parameters].index("cubic_stiffness[y].cubic")] = CUBIC
        return model.simulate(View.whole(rec), theta)["y"]

    long = run(u, np.cos(np.arange(u.size)), matrices | {"x0": [0.0, 0.0]})
    settled = long[-3 * PERIOD :]
    found = run(u[: 3 * PERIOD], settled, matrices)
    np.testing.assert_allclose(found, settled, atol=1e-6 * np.ptp(settled))
    assert np.max(np.abs(long[: 3 * PERIOD] - settled)) > 0.05 * np.ptp(settled)
