"""Start states are read off outputs, which a slow or late sensor shows later than they were."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from sim_devices.physics.catalogue import EFFECTS
from tests.recording_text import channel
from tests.unit.mismatch_engine.cases import recording
from tools.mismatch.engine.pose import pose
from tools.mismatch.engine.projected import Projected
from tools.mismatch.engine.residual import residuals
from tools.mismatch.engine.screen import places
from tools.mismatch.placed import Placed
from tools.mismatch.recording import Recording
from tools.mismatch.recording_load import load
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_sites import sites
from tools.mismatch.simulate_start import prepare
from tools.mismatch.simulate_view import View
from tools.mismatch.twins.base import Run
from tools.mismatch.twins.make import make

RATE_HZ, NOISE = 100.0, 0.02
DAMPING, LAG_S, FINE = 0.45, 0.06, 20


def shaft(folder: Path) -> Path:
    """Write a recording of a shaft that turns against viscous drag, read by a sensor with a lag."""
    rng, n = np.random.default_rng(4), 3000
    u = np.repeat(rng.uniform(-4.0, 4.0, n // 50), 50)
    v = read = 0.0
    y = np.empty(n)
    for k in range(n):
        y[k] = read
        for _ in range(FINE):
            h = 1.0 / RATE_HZ / FINE
            read += h * (v - read) / LAG_S
            v += h * (u[k] - DAMPING * v)
    np.savez(folder / "data.npz", u=u, y=y + rng.normal(0.0, NOISE, n))
    (folder / "recording.toml").write_text(
        f"""format = 1
data = "data.npz"
rate_hz = {RATE_HZ}
[twin]
kind = "mechanical_axis"
[twin.parameters]
mass = 1.0
damping = {DAMPING}
hold = "zero"
"""
        + channel("u", "input", "force", "N")
        + channel("y", "output", "velocity", "m/s")
    )
    return folder / "recording.toml"


def test_a_slow_sensor_does_not_move_the_start_states(tmp_path: Path) -> None:
    posed = pose(load(shaft(tmp_path)), 0.3, 0, None, lambda *_: (set(), []))
    problem = posed.problem
    assert problem.twin.restart
    (lag,) = (
        p for p in places(problem, posed.effects, ()) if p.effect.name == "first_order_lag" and p.site == "output"
    )
    model = Model(problem.twin, [lag])
    theta = model.start(posed.recording)
    theta[-1] = LAG_S
    r = residuals(problem, model, theta)["velocity"][problem.fit_rows]
    assert np.sqrt(np.mean(r**2)) < 1.1 * NOISE


def swing(kind: str) -> Recording:
    """Make a recording of a sprung mass whose position arrives three samples late, from another start than rest."""
    rng, n, dt, late = np.random.default_rng(9), 3000, 0.002, 3
    u = np.repeat(rng.uniform(-4.0, 4.0, n // 5), 5)
    a = np.array([[0.0, 1.0], [-4e4, -12.0]])
    whole = expm(np.block([[a, np.array([[0.0], [2.0]])], [np.zeros((1, 3))]]) * dt)
    x, y = np.array([3e-4, 0.02]), np.empty(n)
    for k in range(n):
        y[k] = x[0]
        x = whole[:2, :2] @ x + whole[:2, 2] * u[k]
    y = np.concatenate([np.full(late, y[0]), y[:-late]]) + rng.normal(0.0, 1e-6, n)
    if kind == "ode":
        own: dict[str, object] = {"k": 4e4, "c": 12.0, "m": 2.0, "hold": "zero"}
        own |= {"states": {"x": {"unit": "m"}, "v": {"unit": "m/s"}}, "outputs": {"position": "x"}}
        own |= {"equations": {"x": "v", "v": "m * force - c * v - k * x"}}
    elif kind == "mechanical_axis":
        own = {"mass": 0.5, "damping": 6.0, "stiffness": 2e4, "hold": "zero"}
    else:
        own = {"A": a.tolist(), "B": [[0.0], [2.0]], "C": [[1.0, 0.0]], "hold": "zero"}
    return recording(kind, {"force": u}, {"position": y}, own)


@pytest.mark.parametrize("kind", ["mechanical_axis", "state_space", "ode"])
@pytest.mark.parametrize("first", [0, 80])
def test_a_late_sensor_does_not_move_the_start_of_a_run(kind: str, first: int) -> None:
    """Also where only samples long after the start may set it. A resonance of three samples' delay turns by 70 deg."""
    rec = swing(kind)
    twin = make(rec)
    if hasattr(twin, "restart"):
        assert not twin.restart
    late = Placed(EFFECTS["dead_time"], "output", "position", "sensor", ("position",), {"time": (0.002, 6.0)})
    model = Model(twin, [late])
    theta = np.concatenate([twin.start(rec), [0.006]])
    ranges = ((first, 1500), (1600, 3000))
    r = model.residual(View(rec, ranges, 40, fit=ranges), theta)["position"]
    assert np.sqrt(np.mean(r[: 500 - first] ** 2)) < 1.1e-6
    assert np.sqrt(np.mean(r**2)) < 1.05e-6


@pytest.mark.parametrize("kind", ["mechanical_axis", "ode"])
def test_the_start_of_a_run_with_a_force_inside_is_read_behind_a_late_sensor(kind: str) -> None:
    rec = swing(kind)
    twin = make(rec)
    target = "position" if kind == "mechanical_axis" else "v"
    drag = Placed(EFFECTS["quadratic_drag"], "feedback", target, "mechanics", ("position",))
    late = Placed(EFFECTS["dead_time"], "output", "position", "sensor", ("position",), {"time": (0.002, 6.0)})
    model = Model(twin, [drag, late])
    theta = np.concatenate([twin.start(rec), np.zeros(len(drag.parts.weights)), [0.006]])
    r = model.residual(View(rec, ((0, 3000),), 40), theta)["position"]
    assert np.sqrt(np.mean(r[40:] ** 2)) < 1.5e-6


@pytest.mark.parametrize("kind", ["mechanical_axis", "ode"])
def test_a_drift_of_a_sensor_is_no_start_state(kind: str) -> None:
    """A free mass starts anew in each stretch, where its sensor shows the place less what has drifted by then."""
    rng, n, dt, noise = np.random.default_rng(12), 4000, 0.002, 1e-3
    u = np.repeat(rng.uniform(-4.0, 4.0, n // 5), 5)
    a = np.array([[0.0, 1.0], [0.0, -6.0]])
    whole = expm(np.block([[a, np.array([[0.0], [2.0]])], [np.zeros((1, 3))]]) * dt)
    x, y = np.array([0.3, 0.2]), np.empty(n)
    for k in range(n):
        y[k] = x[0]
        x = whole[:2, :2] @ x + whole[:2, 2] * u[k]
    y += 0.5 * np.exp(-np.arange(n) * dt / 2.0) + rng.normal(0.0, noise, n)
    if kind == "ode":
        own: dict[str, object] = {"c": 6.0, "m": 2.0, "hold": "zero", "fixed": ["c", "m"]}
        own |= {"states": {"x": {"unit": "m"}, "v": {"unit": "m/s"}}, "outputs": {"position": "x"}}
        own |= {"equations": {"x": "v", "v": "m * force - c * v"}}
    else:
        own = {"mass": 0.5, "damping": 3.0, "hold": "zero"}
    rec = recording(kind, {"force": u}, {"position": y}, own)
    twin = make(rec)
    ranges = ((0, 1300), (1320, 2600), (2620, n))
    view = View(rec, ranges, 40, fit=ranges)
    drift = Placed(EFFECTS["thermal_drift"], "output", "position", "sensor", ("position",), {"time": (0.02, 30.0)})
    model = Model(twin, [drift])
    assert twin.restart
    none, some = (model.residual(view, np.concatenate([twin.start(rec), [2.0, w]]))["position"] for w in (0.0, 1.0))
    per_unit = some - none
    left = none - per_unit * (per_unit @ none) / (per_unit @ per_unit)
    assert np.sqrt(np.mean(none**2)) > 5 * noise
    assert np.sqrt(np.mean(left**2)) < 1.1 * noise


@pytest.mark.parametrize("kind", ["mechanical_axis", "state_space", "ode"])
def test_a_curved_sensor_does_not_bend_the_start_of_a_run(kind: str) -> None:
    """A slow mass is read by a sensor with a curve. Its weights are solved, though the start states depend on them."""
    rng, n, dt, noise = np.random.default_rng(12), 4000, 0.002, 1e-4
    u = np.repeat(rng.uniform(-4.0, 4.0, n // 20), 20)
    damping, spring = 1.0, 0.0 if kind == "mechanical_axis" else 2.0
    a = np.array([[0.0, 1.0], [-2 * spring, -2 * damping]])
    whole = expm(np.block([[a, np.array([[0.0], [2.0]])], [np.zeros((1, 3))]]) * dt)
    x, course = np.array([0.3, 0.2]), np.empty(n)
    for k in range(n):
        course[k] = x[0]
        x = whole[:2, :2] @ x + whole[:2, 2] * u[k]
    middle, half = 0.5 * (course.max() + course.min()), 0.5 * float(np.ptp(course))
    z = (course - middle) / half
    truth = half * np.array([0.10, -0.06, 0.08])
    curve = truth @ np.array([1.5 * z**2 - 0.5, 2.5 * z**3 - 1.5 * z, z])
    y = course + curve + rng.normal(0.0, noise, n)
    if kind == "ode":
        own: dict[str, object] = {"c": 2 * damping, "k": 2 * spring, "hold": "zero", "fixed": ["c", "k"]}
        own |= {"states": {"x": {"unit": "m"}, "v": {"unit": "m/s"}}, "outputs": {"position": "x"}}
        own |= {"equations": {"x": "v", "v": "2 * force - c * v - k * x"}}
    elif kind == "mechanical_axis":
        own = {"mass": 0.5, "damping": damping, "hold": "zero"}
    else:
        own = {"A": a.tolist(), "B": [[0.0], [2.0]], "C": [[1.0, 0.0]], "hold": "zero"}
    rec = recording(kind, {"force": u}, {"position": y}, own)
    settings = {"range": (middle - half, middle + half), "shape": (3.0,), "slope": (1.0,)}
    bent = Placed(EFFECTS["static_nonlinearity"], "output", "position", "sensor", ("position",), settings)
    model = Model(make(rec), [bent])
    theta = np.concatenate([make(rec).start(rec), truth])
    ranges = ((0, 1300), (1320, 2600), (2620, n))
    r = model.residual(View(rec, ranges, 40, fit=ranges), theta)["position"]
    assert np.std(curve) > 100 * noise
    assert np.sqrt(np.mean(r**2)) < 1.1 * noise
    posed = pose(rec, 0.3, 0, None, lambda *_: (set(), []))
    model = Model(posed.problem.twin, [bent])
    _, solved = Projected(posed.problem, model, ("position",), 4000).evaluate(model.start(posed.recording))
    if kind != "ode":  # which searches them
        np.testing.assert_allclose(solved[-3:], truth, rtol=0.02)


BEHIND = sorted(e.name for e in EFFECTS.values() if e.driven and e.kind in ("linear", "add") and "output" in e.sites)


@pytest.mark.parametrize("name", BEHIND)
def test_what_is_measured_at_the_start_depends_on_the_start_alone(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The start state is the same where the effect behind the output is computed over the whole record."""
    rec = swing("ode")
    twin = make(rec)
    drag = Placed(EFFECTS["quadratic_drag"], "feedback", "v", "mechanics", ("position",))
    reached: list[int] = []

    def reach(run: Run, at: np.ndarray) -> int:
        reached.append(of_run(run, at))
        return reached[-1]

    of_run = Run.reach
    view = View(rec, ((0, rec.n),), 40)
    behind = [p for p in sites(twin, rec, EFFECTS[name]) if p.site == "output"]
    for place in behind:
        model = Model(twin, [drag, prepare(Model(twin), view, twin.start(rec), place)])
        theta = model.start(rec)
        own = slice(model.slices(1)[0].start, None)
        theta[own] = [0.1 * p.scale for p in model.parameters[own]]
        found: list[np.ndarray] = []
        for one in (reach, lambda run, at: run.t.size):
            monkeypatch.setattr(Run, "reach", one)
            found.append(model.in_front(View(rec, ((0, rec.n),), 40), theta)["position"])
        np.testing.assert_allclose(found[0], found[1], rtol=0.0, atol=1e-5 * float(np.ptp(found[1])))
    assert not behind or 0 < max(reached) < rec.n
