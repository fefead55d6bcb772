"""Start states of a twin of equations: set by the first samples, and again where a stretch starts afresh."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_model.ode_systems import MOTOR, RATE_HZ, command, pendulum, recorded
from tools.mismatch.recording import Recording
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_sites import sites
from tools.mismatch.simulate_view import View
from tools.mismatch.twins import equations
from tools.mismatch.twins.make import make
from tools.mismatch.twins.memo import Start
from tools.mismatch.twins.ode_run import run_equations
from tools.mismatch.twins.ode_start import start_step


def test_a_start_that_nobody_knows_is_set_by_the_first_samples(tmp_path: Path) -> None:
    u = command()
    t = np.arange(u.size) / RATE_HZ
    exact = solve_ivp(
        lambda now, x: [x[1], (20 * np.interp(now, t, u) - x[1]) / 0.08], (0, t[-1]), [5.0, -12.0],
        t_eval=t, rtol=1e-9, atol=1e-9, max_step=0.5 / RATE_HZ,
    ).y[0]  # fmt: skip
    recording = recorded(tmp_path, MOTOR, u, exact)
    model = Model(make(recording))
    view = View(recording, ((0, 200), (300, 600)), 40)
    assert np.max(np.abs(model.residual(view, model.start(recording))["angle"])) < 1e-3
    assert model.twin.restart


def test_a_stretch_begins_where_it_was_read_and_not_where_a_drifted_run_has_come_to(tmp_path: Path) -> None:
    """Without the weight the twin is turns away by then, and the sine has the wrong phase there."""
    recording, _ = pendulum(tmp_path)
    (place,) = sites(make(recording), recording, EFFECTS["gravity_load"])
    model = Model(make(recording), [place])
    theta = model.start(recording)
    plain = Model(make(recording)).simulate(View.whole(recording), theta[:1])["angle"]
    assert np.max(np.abs(plain - recording.outputs["angle"])) > math.pi
    theta[model.slices(0)[1]] = -160.0 * math.cos(0.3), 160.0 * math.sin(0.3)
    view = View(recording, ((40, 262), (501, 700), (760, 900)), 40, afresh=True)
    assert np.max(np.abs(model.residual(view, theta)["angle"])) < 0.02


def noisy_motor(folder: Path) -> tuple[Recording, np.ndarray]:
    """A recording of the motor with sensor noise of 10 mrad, and the angle without it (600,)."""
    u = command()
    plain = recorded(folder / "plain", MOTOR, u, 2.0 * u)
    twin = make(plain)
    true = Model(twin).simulate(View.whole(plain), twin.start(plain))["angle"]
    noise = 0.01 * np.random.default_rng(7).standard_normal(u.size)
    return recorded(folder / "noisy", MOTOR, u, true + noise), true


def test_a_stretch_that_starts_afresh_is_met_by_all_its_samples_and_by_no_other(tmp_path: Path) -> None:
    recording, true = noisy_motor(tmp_path)
    twin = make(recording)
    theta, ranges = twin.start(recording), ((0, 200), (220, 600))
    inside = np.r_[40:200, 260:600]

    def left(recording: Recording, afresh: bool) -> float:
        view = View(recording, ranges, 40, afresh=afresh)
        whole = Model(twin).whole(view, theta)["angle"]
        return float(np.sqrt(np.mean((whole - true)[inside] ** 2)))

    # two numbers from 200 and 380 samples of 10 mrad: 0.01 * sqrt(4 / 580) = 0.8 mrad; speed and angle from 40 more
    assert left(recording, True) < 1.3e-3 < left(recording, False)
    gap = recording.outputs["angle"].copy()
    gap[200:220] += 5.0
    beside = replace(recording, outputs={"angle": gap})
    assert left(beside, True) == pytest.approx(left(recording, True), rel=1e-6)


def arm(folder: Path, noise_rad: float) -> Recording:
    """An arm with gravity and friction that is larger at rest, by small steps; it sticks at every turn."""
    rng = np.random.default_rng(8)
    u = np.repeat(rng.uniform(-0.8, 0.8, 30), 40)
    steps, angle, speed = 40, 0.0, 0.0
    read = np.empty(u.size)
    h = 1 / RATE_HZ / steps
    for i in range(u.size):
        read[i] = angle
        for _ in range(steps):
            push = 20.0 * u[i] - 7.5 * math.sin(angle) - 1.0 * speed
            friction = 2.5 + 2.9 * math.exp(-((speed / 0.15) ** 2))
            slowed = speed + h * push
            # dry friction stops a body within the step and holds it up to its level
            speed = math.copysign(max(abs(slowed) - h * friction, 0.0), slowed)
            angle += h * speed
    return recorded(folder, ARM, u, read + noise_rad * rng.standard_normal(u.size))


ARM = """
[twin]
kind = "ode"

[twin.states]
angle = "rad"
speed = "rad/s"

[twin.equations]
angle = "speed"
speed = "gain * command - damping * speed"

[twin.parameters]
gain = 20.0
damping = 1.0
hold = "zero"
"""


def test_a_stretch_in_which_a_body_sticks_is_met(tmp_path: Path) -> None:
    """A whole step of Gauss-Newton leads to another place of rest."""
    recording = arm(tmp_path, 2e-3)
    twin = make(recording)
    (gravity,), (friction, *_) = (
        sites(twin, recording, EFFECTS[name]) for name in ("gravity_load", "stribeck_friction")
    )
    model = Model(twin, [gravity, friction])
    theta = model.start(recording)
    names = [p.name for p in model.parameters]
    known = {"sine": -7.5, "cosine": 0.0, "stribeck_speed": 0.15, "level": 2.5, "extra": 2.9}
    for name, value in known.items():
        theta[next(i for i, n in enumerate(names) if n.rsplit(".", 1)[-1] == name)] = value
    view = View(recording, tuple((a, a + 100) for a in range(0, 1200, 100)), 20, afresh=True)
    left = model.residual(view, theta)["angle"]
    assert np.sqrt(np.mean(left**2)) < 1.2 * 2e-3


def test_linear_equations_know_how_their_starts_act_without_a_run_each(tmp_path: Path) -> None:
    """The same equations with a force of no size have no exact steps, and take differences of runs."""
    recording, _ = noisy_motor(tmp_path)
    twin = make(recording)
    (place,) = sites(twin, recording, EFFECTS["gravity_load"])
    plain, forced = Model(twin), Model(twin, [place])

    def starts(model: Model) -> Start:
        view = View(recording, ((0, 200), (220, 600)), 40, afresh=True).near()
        model.simulate(view, model.start(recording))
        assert view.nearby is not None
        (found,) = view.nearby.of_stretches.values()
        return found

    exact, by_runs = starts(plain), starts(forced)
    assert exact.x0 == pytest.approx(by_runs.x0, abs=2e-3)
    assert exact.states == pytest.approx(by_runs.states, abs=1e-3 * np.max(np.abs(exact.states)))
    assert exact.slopes == pytest.approx(by_runs.slopes, abs=1e-3 * np.max(np.abs(exact.slopes)))


def test_runs_of_one_search_start_near_each_other(tmp_path: Path) -> None:
    """They meet the recording as well as runs by themselves do, and change smoothly with the parameters."""
    recording, _ = pendulum(tmp_path)
    (place,) = sites(make(recording), recording, EFFECTS["gravity_load"])
    model = Model(make(recording), [place])
    theta = model.start(recording)
    theta[model.slices(0)[1]] = -150.0, 40.0
    view = View(recording, ((40, 262), (501, 700), (760, 900)), 40, afresh=True)
    near = view.near()
    first = model.residual(near, theta)["angle"]

    def residual(view: View, step: float) -> np.ndarray:
        moved = theta.copy()
        moved[model.slices(0)[1]] *= 1.0 + step
        return model.residual(view, moved)["angle"]

    alone = residual(View(recording, view.ranges, 40, afresh=True), 4e-3)
    assert np.mean(residual(near, 4e-3) ** 2) < 1.01 * np.mean(alone**2)
    bend = [np.max(np.abs(residual(near, 2 * h) - 2 * residual(near, h) + first)) for h in (1e-3, 2e-3)]
    slope = np.max(np.abs(residual(near, 1e-3) - first))
    assert 3.0 < bend[1] / bend[0] < 5.0  # a second difference goes with the square of the step
    assert bend[0] < 0.05 * slope


def test_a_run_outside_a_search_is_not_that_of_a_search(tmp_path: Path) -> None:
    """A result does not depend on what a process has run before."""
    recording, _ = pendulum(tmp_path)
    (place,) = sites(make(recording), recording, EFFECTS["gravity_load"])
    model = Model(make(recording), [place])
    theta = model.start(recording)
    theta[model.slices(0)[1]] = -150.0, 40.0
    view = View(recording, ((40, 262), (501, 700)), 40, afresh=True)
    moved = theta.copy()
    moved[model.slices(0)[1]] *= 1.05
    near = view.near()
    model.simulate(near, theta)
    model.simulate(near, moved)
    fresh = View(recording, view.ranges, 40, afresh=True)
    assert np.array_equal(model.simulate(view, moved)["angle"], model.simulate(fresh, moved)["angle"])


@pytest.mark.parametrize(("step", "takes_two_runs"), [(4e-3, True), (-0.8, False)])
def test_a_search_goes_on_from_the_starts_of_an_earlier_place_while_these_suit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: float, takes_two_runs: bool
) -> None:
    recording, _ = pendulum(tmp_path)
    (place,) = sites(make(recording), recording, EFFECTS["gravity_load"])
    model = Model(make(recording), [place])
    theta = model.start(recording)
    theta[model.slices(0)[1]] = -150.0, 40.0
    view = View(recording, ((40, 262), (501, 700), (760, 900)), 40, afresh=True)
    first = view.near()
    model.simulate(first, theta)
    assert first.nearby is not None
    theta[model.slices(0)[1]] *= 1.0 + step
    alone = model.residual(view.near(), theta)["angle"]
    runs: list[None] = []

    def counted(*args: Any) -> np.ndarray:
        runs.append(None)
        return run_equations(*args)

    monkeypatch.setattr(equations, "run_equations", counted)
    found = model.residual(view.near(first.nearby.elsewhere()), theta)["angle"]
    assert (len(runs) == 2) is takes_two_runs
    if takes_two_runs:
        assert np.mean(found**2) < 1.01 * np.mean(alone**2)
    else:
        assert np.array_equal(found, alone)


def test_the_step_of_every_stretch_is_that_of_least_squares() -> None:
    """And the squares that it foretells are those which are left. The second state of one stretch is not seen."""
    rng = np.random.default_rng(3)
    slopes, missed = rng.standard_normal((30, 2, 3)), rng.standard_normal((30, 2))
    slopes[12:20, :, 1] = 0.0
    edges = [(0, 12), (12, 20), (20, 30)]
    turn, left = start_step(slopes, missed, edges)
    for k, (a, b) in enumerate(edges):
        c, y = slopes[a:b].reshape(-1, 3), missed[a:b].reshape(-1)
        step = np.linalg.lstsq(c, y)[0]
        np.testing.assert_allclose(turn[k], step, atol=1e-13)
        assert left[k] == pytest.approx(float(np.sum((y - c @ step) ** 2)), rel=1e-12)
