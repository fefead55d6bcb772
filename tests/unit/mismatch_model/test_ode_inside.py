"""Forces and flows inside a twin of equations: friction, weight, springs, leaks of a storage."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_model.ode_systems import CHANNELS, MOTOR, PENDULUM, RATE_HZ, command, pendulum, recorded
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_flows import flow_starts
from tools.mismatch.simulate_sites import sites
from tools.mismatch.simulate_start import prepare
from tools.mismatch.simulate_view import View
from tools.mismatch.twins.base import Force
from tools.mismatch.twins.make import make
from tools.mismatch.twins.ode import inside_of
from tools.mismatch.twins.ode_run import Drive


def test_dry_friction_brings_a_body_to_rest_and_keeps_it_there(tmp_path: Path) -> None:
    """Closed form: deceleration mu from v0 stops after v0 / mu, v0^2 / (2 mu) further on."""
    twin = """
[twin]
kind = "ode"
[twin.states]
angle = "rad"
speed = { unit = "rad/s", start = 3.0 }
[twin.equations]
angle = "speed"
speed = "command"
"""
    t = np.arange(400) / RATE_HZ
    mu = 2.0
    y = np.where(t < 1.5, 3 * t - mu * t * t / 2, 2.25)
    push = np.where((t > 2.0) & (t < 3.0), 1.9, 0.0)
    recording = recorded(tmp_path, twin, push, y)
    twin_ = make(recording)
    place = sites(twin_, recording, EFFECTS["coulomb_friction"])[0]
    assert (place.site, place.target) == ("feedback", "speed")
    model = Model(twin_, [place])
    theta = model.start(recording)
    theta[model.slices(0)[1]] = mu, 0.0, 0.0
    residual = model.residual(View.whole(recording), theta)["angle"]
    assert np.max(np.abs(residual)) < 1e-4
    assert np.ptp(model.simulate(View.whole(recording), theta)["angle"][160:]) == 0.0


@pytest.mark.parametrize(
    ("name", "searched", "weights"),
    [("coulomb_friction", (), (4.0, 0.0, 0.0)), ("stribeck_friction", (0.5,), (4.0, 0.0, 0.0, 6.0))],
)
def test_parts_of_a_step_where_a_body_sticks_are_about_as_good_as_parts_throughout(
    name: str, searched: tuple[float, ...], weights: tuple[float, ...], tmp_path: Path
) -> None:
    recording = recorded(tmp_path, MOTOR, 0.5 * command(), 0.1 * command())
    twin = inside_of(make(recording))
    assert twin is not None
    place = sites(twin, recording, EFFECTS[name])[0]
    values = twin.values(Model(twin).start(recording))
    force = Force(place.effect, {"speed": (5.0,)}, np.array(searched), np.array(weights), 0, place.target)
    inside = twin.packed([force], values)
    whole = np.zeros(1, np.int64), np.array([recording.n], np.int64)
    u = np.ascontiguousarray(recording.inputs["command"][:, None])
    limits = np.full(2, -np.inf), np.full(2, np.inf)

    def run(sub: int, fine: int) -> np.ndarray:
        drive = Drive(u, twin.held, recording.t, recording.dt, sub, fine, *whole)
        return twin.equations.states(np.zeros((1, 2)), drive, values, inside, limits)[:, 1]

    true = run(512, 1)
    rough, throughout, parts = (np.std(run(*steps) - true) for steps in ((1, 1), (8, 1), (1, 8)))
    assert np.any(true == 0.0)
    assert np.ptp(true) > 1.0
    assert parts < 1.5 * throughout  # whole steps between add their own error
    assert rough > 5.0 * parts


def test_forces_of_an_axis_and_of_equations_are_the_same(tmp_path: Path) -> None:
    """One declaration of each effect serves both; two integrators meet within their own step errors."""
    u = 3.0 * command(500)
    axis = """
[twin]
kind = "mechanical_axis"
[twin.parameters]
mass = 1.0
damping = 0.4
stiffness = 30.0
"""
    equations = """
[twin]
kind = "ode"
[twin.states]
position = "rad"
velocity = "rad/s"
[twin.equations]
position = "velocity"
velocity = "torque - c * velocity - k * position"
[twin.parameters]
c = 0.4
k = 30.0
"""
    channels = CHANNELS.replace('"command"', '"torque"').replace('"angle"', '"position"').replace('"V"', '"N m"')
    one = recorded(tmp_path / "equations", equations, u, 0.1 * u[::-1], channels)
    for name, weights, searched in (
        ("cubic_stiffness", (400.0, 3.0), ()),
        ("cubic_stiffness", (400.0, 3.0, 60.0), ()),
        ("gravity_load", (-40.0, 9.0), ()),
        ("coulomb_friction", (0.6, 0.1, 0.05), ()),
        ("quadratic_drag", (6.0,), ()),
        ("amplitude_dependent_damping", (300.0,), ()),
        ("clearance", (200.0,), (0.02, 0.01)),
        ("constant_load", (9.0,), ()),
        ("hysteresis", (1.0,), (0.05,)),
    ):
        moved = []
        for recording in (one, None):
            recording = recording or recorded(tmp_path / name, axis, u, moved[0], channels)
            every = sites(make(recording), recording, EFFECTS[name])
            forces = [p for p in every if p.site == "feedback"]
            place = next(p for p in reversed(forces) if len(p.effect.parts({}).weights) == len(weights))
            model = Model(make(recording), [place])
            theta = model.start(recording)
            a, b = model.slices(0)
            theta[a], theta[b] = searched, weights
            moved.append(model.simulate(View.whole(recording), theta)["position"])
        plain = Model(make(one)).simulate(View.whole(one), np.array([0.4, 30.0, 0.0]))
        assert np.std(moved[0] - plain["position"]) > 0.1 * np.std(moved[0]), name
        assert np.std(moved[0] - moved[1]) < 0.02 * np.std(moved[0]), name


def test_a_weight_on_a_lever_is_a_force_at_an_angle_alone(tmp_path: Path) -> None:
    recording, exact = pendulum(tmp_path / "angle")
    (place,) = sites(make(recording), recording, EFFECTS["gravity_load"])
    place = replace(place, settings={"travel": (float(np.ptp(exact)),)})
    model = Model(make(recording), [place])
    theta = model.start(recording)
    theta[model.slices(0)[1]] = -160.0 * math.cos(0.3), 160.0 * math.sin(0.3)
    assert np.max(np.abs(model.residual(View.whole(recording), theta)["angle"])) < 1e-3
    found = {h.name: h.value for h in model.human(theta)[place.label]}
    assert found["largest_load"] == pytest.approx(160.0 * 0.09 / 20.0)  # in volts of the command
    assert found["angle_at_rest"] == pytest.approx(0.3)
    metres = PENDULUM.replace('"rad"', '"m"').replace('"rad/s"', '"m/s"')
    line = recorded(tmp_path / "line", metres, recording.inputs["command"], exact, CHANNELS.replace('"rad"', '"m"'))
    assert sites(make(line), line, EFFECTS["gravity_load"]) == []


def test_flows_of_two_tanks_are_those_of_the_source(tmp_path: Path) -> None:
    """Root outflow of the upper tank into the lower, and overflow, against an adaptive solver."""
    twin = """
[twin]
kind = "ode"
[twin.states]
upper = { unit = "m", start = 0.5, min = 0.0 }
level = { unit = "m", start = 0.4, min = 0.0 }
[twin.equations]
upper = "pump * command - a * upper"
level = "a * upper - b * level"
[twin.parameters]
pump = 1.0
a = 0.1
b = 0.1
"""
    channels = CHANNELS.replace('"angle"', '"level"').replace('"rad"', '"m"')
    u = 1.1 + 0.4 * command()
    t = np.arange(u.size) / RATE_HZ

    def slopes(now: float, h: np.ndarray) -> list[float]:
        top, low = np.sqrt(max(h[0], 0.0)), np.sqrt(max(h[1], 0.0))
        over = max(h[0] - 0.9, 0.0)
        inside = np.interp(now, t, u) - 0.1 * h[0] - 0.8 * top - 3.0 * over
        return [inside, 0.1 * h[0] - 0.1 * h[1] + 0.8 * top - 0.7 * low + 1.2 * over]

    exact = solve_ivp(slopes, (0, t[-1]), [0.5, 0.4], t_eval=t, rtol=1e-9, atol=1e-9, max_step=0.5 / RATE_HZ).y
    assert exact[0].max() > 1.0
    recording = recorded(tmp_path, twin, u, exact[1], channels)
    tanks = make(recording)
    root = next(p for p in sites(tanks, recording, EFFECTS["square_root_outflow"]) if p.target == "upper+level")
    over = next(p for p in sites(tanks, recording, EFFECTS["overflow"]) if p.target == "upper")
    pairs = {p.name: p.pairs for p in tanks.places}  # type: ignore[attr-defined]
    assert pairs["upper+level"] == (0.0, 0.0, 0.0, 1.0, 1.0, 1.0)
    settings = {"range": (0.0, 1.0), "rate": (1.0,)}
    root = replace(root, settings={**settings, "pairs": pairs["upper+level"]})
    over = replace(over, settings={**settings, "pairs": pairs["upper"]})
    model = Model(tanks, [root, over])
    theta = model.start(recording)
    for k, values in enumerate([(0.0, 0.0, 0.8, 0.8, 0.7), (0.9, 3.0, 1.2)]):
        a, b = model.slices(k)
        theta[a.start : b.stop] = values
    residual = model.residual(View.whole(recording), theta)["level"]
    assert np.max(np.abs(residual)) < 2e-5


LINEAR_TANKS = """
[twin]
kind = "ode"
[twin.states]
upper = { unit = "m", start = 1.0 }
level = { unit = "m", start = 1.0 }
[twin.equations]
upper = "gain * command - a * upper - deficit"
level = "a * upper - b * level + surplus"
[twin.parameters]
gain = 20.0
a = 7.0
b = 7.0
deficit = 7.0
surplus = 0.0
"""


def test_flows_begin_in_place_of_the_linear_terms_that_are_their_tangents(tmp_path: Path) -> None:
    channels = CHANNELS.replace('"angle"', '"level"').replace('"rad"', '"m"')
    u = 0.7 + 0.5 * command()
    t = np.arange(u.size) / RATE_HZ

    def slopes(now: float, h: np.ndarray) -> list[float]:
        top, low = np.sqrt(max(h[0], 0.0)), np.sqrt(max(h[1], 0.0))
        return [20 * np.interp(now, t, u) - 14 * top, 14 * top - 14 * low]

    exact = solve_ivp(slopes, (0, t[-1]), [1.0, 1.0], t_eval=t, rtol=1e-9, atol=1e-9, max_step=0.5 / RATE_HZ).y
    recording = recorded(tmp_path, LINEAR_TANKS, u, exact[1], channels)
    tanks = make(recording)
    view = View.whole(recording)
    linear = Model(tanks)
    given = linear.start(recording)
    root = next(p for p in sites(tanks, recording, EFFECTS["square_root_outflow"]) if p.target == "upper+level")
    root = prepare(linear, view, given, root)
    model = Model(tanks, [root])
    theta = model.carry(linear, given, recording)
    theta[model.slices(0)[0]] = 0.0
    start = flow_starts(model, 0, view, theta, "level")[0]
    assert np.all(start[model.slices(0)[1]] > 8.0)  # the roots carry the flow,
    assert np.all(np.abs(start[[1, 2]]) < 3.0)  # and the linear terms do not
    before = float(np.std(linear.residual(view, given)["level"]))
    assert float(np.std(model.residual(view, start)["level"])) < 0.5 * before


TWO_BODIES = """
[twin]
kind = "ode"
[twin.states]
motor = "rad"
motor_speed = "rad/s"
load = "rad"
load_speed = "rad/s"
[twin.equations]
motor = "motor_speed"
motor_speed = "(torque - 0.6 * motor_speed - stiffness * (motor - 3 * load)) / 0.05"
load = "load_speed"
load_speed = "(3 * stiffness * (motor - 3 * load) - 2 * load_speed) / 0.9"
[twin.parameters]
stiffness = 40.0
"""


def test_play_of_a_joint_is_a_spring_that_takes_hold_beyond_the_gap(tmp_path: Path) -> None:
    """A geared joint with play against scipy's integrator over the same law, sample by sample."""
    u = 2.0 * command()
    channels = CHANNELS.replace('"command"', '"torque"').replace('"angle"', '"load"').replace('"V"', '"N m"')
    recording = recorded(tmp_path, TWO_BODIES, u, 0.1 * u[::-1], channels)
    twin = make(recording)
    (place,) = sites(twin, recording, EFFECTS["clearance"])[-1:]
    assert place.target == "motor - 3 load"
    model = Model(twin, [replace(place, settings={"size": (1.0,), "travel": (1.0,)})])
    theta = model.start(recording)
    a, b = model.slices(0)
    theta[a], theta[b] = (0.02, 0.005), 40.0 / 0.05
    found = model.simulate(View.whole(recording), theta)["load"]
    start = model.start_states(View.whole(recording), theta)

    def rates(t: float, x: np.ndarray, k: int) -> list[float]:
        torque = u[k] + (u[k + 1] - u[k]) * (t * RATE_HZ - k)
        d = x[0] - 3 * x[2] - 0.005
        pull = 40.0 * (x[0] - 3 * x[2] - np.clip(d, -0.02, 0.02))
        return [x[1], (torque - 0.6 * x[1] - pull) / 0.05, x[3], (3 * pull - 2 * x[3]) / 0.9]

    x, course = start, [start[2]]
    for k in range(u.size - 1):
        x = solve_ivp(rates, (k / RATE_HZ, (k + 1) / RATE_HZ), x, args=(k,), rtol=1e-9, atol=1e-12).y[:, -1]
        course.append(x[2])
    plain = Model(twin).simulate(View.whole(recording), theta[: model.n_base])["load"]
    assert np.std(found - plain) > 0.01 * np.std(found)
    np.testing.assert_allclose(found, course, rtol=0, atol=2e-3 * np.std(plain - found))


@pytest.mark.parametrize("lean", [None, 0.4])
def test_a_loop_that_bends_within_wide_steps_is_its_differential_equation(tmp_path: Path, lean: float | None) -> None:
    """Against an integrator with steps of its own (Wen 1976, eq. 3): parts are needed where it turns alone."""
    twin_text = (
        '[twin]\nkind = "ode"\n[twin.states]\nangle = "rad"\nrate = "rad/s"\n[twin.equations]\nangle = "rate"\n'
        'rate = "command - 0.4 * rate - k * angle"\n[twin.parameters]\nk = 30.0\n'
    )
    recording = recorded(tmp_path, twin_text, 20.0 * command(), 0.1 * command())
    twin = inside_of(make(recording))
    assert twin is not None
    effect = EFFECTS["hysteresis"]
    forms = [f for f in effect.variants if "dot z" in f.equation and len(f.parts({}).nonlinear) == (2 if lean else 1)]
    yielding, stiffness = 0.1, 20.0
    searched = [yielding] if lean is None else [yielding, lean]
    force = Force(forms[0], {"travel": (1.0,)}, np.array(searched), np.array([stiffness * yielding]), 0, "rate")
    values = twin.values(Model(twin).start(recording))
    inside = twin.packed([force], values)
    u, whole = recording.inputs["command"], (np.zeros(1, np.int64), np.array([recording.n], np.int64))
    sub, fine = twin.substeps(recording.dt, inside)

    def slopes(t: float, s: np.ndarray) -> list[float]:
        x, v, z = s
        bend = v - (abs(v) * z + (lean or 0.0) * v * abs(z)) / yielding
        return [v, float(np.interp(t, recording.t, u)) - 0.4 * v - 30.0 * x - stiffness * z, bend]

    true = solve_ivp(slopes, (0.0, recording.t[-1]), np.zeros(3), t_eval=recording.t, rtol=1e-9, max_step=recording.dt)

    def error(sub: int, fine: int) -> float:
        drive = Drive(u[:, None].copy(), twin.held, recording.t, recording.dt, sub, fine, *whole)
        limits = np.full(2, -np.inf), np.full(2, np.inf)
        x = twin.equations.states(np.zeros((1, 2)), drive, values, inside, limits)[:, 0]
        return float(np.max(np.abs(x - true.y[0])) / np.ptp(true.y[0]))

    assert np.max(np.abs(true.y[2])) > 0.6 * yielding
    assert sub * fine > sub
    assert error(sub, fine) < 1.5 * error(sub * fine, 1) + 1e-6
    assert error(sub, fine) < 1e-4
    assert error(sub, 1) > 2.0 * error(sub, fine)
