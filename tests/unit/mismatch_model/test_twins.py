"""Twins against scipy's simulations and closed forms."""

from __future__ import annotations

import importlib
import sys
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import StateSpace, dlsim, lsim

from hal.arrays import Array
from hal.trust import NotTrusted, trust_package
from sim_devices.physics.catalogue import EFFECTS
from sim_devices.physics.forces import COGGING, FRICTION, SPRING
from tests.unit.mismatch_model.made import recording
from tools.errors import RecordingError
from tools.mismatch.placed import Placed
from tools.mismatch.recording import Recording
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_sites import sites
from tools.mismatch.simulate_start import prepare
from tools.mismatch.simulate_view import View
from tools.mismatch.twins.base import Run
from tools.mismatch.twins.feedback import Body, Rows, run_feedback
from tools.mismatch.twins.linear import (
    discretise,
    felt_at_most,
    free_response,
    run_output,
    run_states,
    start_state,
)
from tools.mismatch.twins.make import make

AXIS = {"force": "N", "position": "m", "velocity": "m/s"}


def force(n: int, dt: float) -> Array:
    t = np.arange(n) * dt
    return 3 * np.sin(2 * np.pi * 1.3 * t) + 2 * np.sin(2 * np.pi * 4.1 * t + 1)


def as_given(rec: Recording, init: int = 0) -> dict[str, Array]:
    model = Model(make(rec))
    return model.simulate(View.whole(rec, init), model.start(rec))


def space(matrices: dict[str, Any], u: dict[str, Array], outputs: tuple[str, ...], dt: float) -> Recording:
    n = next(iter(u.values())).size
    # outputs are stand-ins: with x0 given nothing of them is used
    noise = np.random.default_rng(0).standard_normal(n)
    return recording("state_space", dt, u, dict.fromkeys(outputs, noise), {}, matrices)


@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_state_space_against_lsim(hold: str) -> None:
    dt, n = 0.01, 400
    a = [[0.0, 1.0, 0.0], [-400.0, -6.0, 30.0], [0.0, 0.0, -9.0]]
    b, c, d = [[0.0, 0.1], [5.0, 0.0], [1.0, 2.0]], [[1.0, 0.0, 0.0], [0.0, 0.2, 1.0]], [[0.0, 0.0], [0.5, 0.0]]
    u = {"p": force(n, dt), "q": np.cos(np.arange(n) * 0.05)}
    x0 = [0.3, -1.0, 0.2]
    rec = space({"A": a, "B": b, "C": c, "D": d, "x0": x0, "y0": [0.1, -0.2], "hold": hold}, u, ("y", "z"), dt)
    stacked = np.stack(list(u.values()), axis=1)
    t = np.arange(n) * dt
    _, want, _ = lsim(StateSpace(a, b, c, d), stacked, t, X0=x0, interp=hold == "linear")
    got = as_given(rec)
    np.testing.assert_allclose(got["y"], want[:, 0] + 0.1, atol=1e-7)
    np.testing.assert_allclose(got["z"], want[:, 1] - 0.2, atol=1e-7)


def test_discrete_state_space_against_dlsim() -> None:
    dt, n = 0.02, 300
    a, b, c, d = [[1.5, -0.7], [1.0, 0.0]], [[1.0], [0.0]], [[0.2, 0.1]], [[0.05]]
    u = {"u": force(n, dt)}
    rec = space({"A": a, "B": b, "C": c, "D": d, "discrete": True}, u, ("y",), dt)
    _, want, _ = dlsim((*map(np.array, (a, b, c, d)), dt), u["u"])
    np.testing.assert_allclose(as_given(rec)["y"], np.ravel(want), atol=1e-9)


def test_state_space_round_trip() -> None:
    """What a corrected twin writes simulates the same."""
    dt, n = 0.01, 300
    a, b, c = [[-1.0, 2.0], [-8.0, -3.0]], [[1.0], [0.5]], [[2.0, -1.0]]
    u = {"u": force(n, dt)}
    rec = space({"A": a, "B": b, "C": c}, u, ("y",), dt)
    twin = make(rec)
    text = twin.to_text(twin.start(rec))
    again = space(dict(text), u, ("y",), dt)
    np.testing.assert_allclose(as_given(again)["y"], as_given(rec)["y"], atol=1e-9)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("A", [[1.0, 2.0]], "A has shape"),
        ("B", [[1.0]], "B has shape"),
        ("C", [[0.0, float("nan")]], "C: row 1, column 2 is nan"),
        ("hold", "cubic", "hold must be"),
        ("discrete", 1, "discrete must be"),
        ("Q", 1, "'Q' is not a parameter"),
    ],
)
def test_state_space_errors(key: str, value: object, message: str) -> None:
    good: dict[str, Any] = {"A": [[0.0, 1.0], [-4.0, -1.0]], "B": [[0.0], [1.0]], "C": [[1.0, 0.0]]}
    with pytest.raises(RecordingError, match=message):
        make(space({**good, key: value}, {"u": np.ones(60)}, ("y",), 0.1))


def test_axis_against_lsim() -> None:
    dt, n, m, c, k = 1e-3, 4000, 2.0, 8.0, 900.0
    f, t = force(n, dt), np.arange(n) * dt
    _, want, _ = lsim(StateSpace([[0, 1], [-k / m, -c / m]], [[0], [1 / m]], np.eye(2), np.zeros((2, 1))), f + 0.7, t)
    rec = recording(
        "mechanical_axis", dt, {"force": f}, {"position": want[:, 0], "velocity": want[:, 1]}, AXIS,
        {"mass": m, "damping": c, "stiffness": k, "offset_force": 0.7},
    )  # fmt: skip
    got = as_given(rec, 40)
    np.testing.assert_allclose(got["position"], want[:, 0], atol=1e-9)
    np.testing.assert_allclose(got["velocity"], want[:, 1], atol=1e-8)


def test_axis_parameters_are_estimated() -> None:
    dt, n, m, c, k = 1e-3, 8000, 2.0, 8.0, 900.0
    f, t = force(n, dt), np.arange(n) * dt
    _, want, _ = lsim(([1 / m], [1, c / m, k / m]), f, t)
    y = want + 1e-6 * np.random.default_rng(0).standard_normal(n)
    rec = recording("mechanical_axis", dt, {"force": f}, {"position": y}, AXIS, {"stiffness": 900.0})
    values = {h.name: h.value for h in make(rec).human(make(rec).start(rec))}
    assert values["mass"] == pytest.approx(m, rel=0.02)
    assert values["damping"] == pytest.approx(c, rel=0.1)
    assert values["offset_force"] == 0.0


def with_effect(rec: Recording, name: str, weights: list[float], q: list[float]) -> dict[str, Array]:
    twin = make(rec)
    place = next(p for p in sites(twin, rec, EFFECTS[name]) if p.site == "feedback")
    model = Model(twin, [Placed(place.effect, place.site, place.target, place.stage, place.outputs, {})])
    theta = model.start(rec)
    a, b = model.slices(0)
    theta[a], theta[b] = q, weights
    return model.simulate(View.whole(rec, 30), theta)


def test_coulomb_decay_closed_form() -> None:
    """Mass on a spring with dry friction: every half cycle loses 2 F/k, then it sticks (Den Hartog, 1931)."""
    dt, n, w, level = 5e-4, 6000, 20.0, 10.0
    t = np.arange(n) * dt
    x0, shift = 0.2, level / w**2  # metres; level in N/kg
    want = np.empty(n)
    amplitude, sign = x0, 1.0
    for k in range(n):
        half, phase = divmod(w * t[k], np.pi)
        amplitude = x0 - (2 * half + 1) * shift
        sign = 1.0 if half % 2 == 0 else -1.0
        want[k] = sign * (amplitude * np.cos(phase) + shift) if amplitude > 0 else np.nan
    last = int(np.argmax(np.isnan(want)))
    want[last:] = want[last - 1]
    rec = recording(
        "mechanical_axis", dt, {"force": np.zeros(n)}, {"position": want}, AXIS,
        {"mass": 1.0, "damping": 0.0, "stiffness": w * w},
    )  # fmt: skip
    got = with_effect(rec, "coulomb_friction", [level, 0.0, 0.0], [])
    np.testing.assert_allclose(got["position"], want, atol=2e-3 * x0)
    assert np.ptp(got["position"][-500:]) < 1e-9


def test_duffing_against_an_ode_solver() -> None:
    dt, n = 2e-3, 2000
    f, t = force(n, dt), np.arange(n) * dt
    k3, k2 = 4e4, 300.0

    def rhs(s: float, y: Array) -> list[float]:
        u = np.interp(s, t, f)
        return [y[1], u - 3 * y[1] - 400 * y[0] - k3 * y[0] ** 3 - k2 * y[0] ** 2]

    want = solve_ivp(rhs, (0, t[-1]), [0.0, 0.0], t_eval=t, rtol=1e-9, atol=1e-11, max_step=dt).y[0]
    rec = recording(
        "mechanical_axis", dt, {"force": f}, {"position": want}, AXIS, {"mass": 1.0, "damping": 3.0, "stiffness": 400.0}
    )
    got = with_effect(rec, "cubic_stiffness", [k3, k2], [])["position"]
    assert np.max(np.abs(got - want)) < 2e-3 * np.ptp(want)


@pytest.mark.parametrize("pieces", [1, 3])
def test_a_spring_of_an_axis_of_which_only_the_velocity_was_recorded(pieces: int) -> None:
    """Its force follows the position, counted from the velocity, however often the simulation starts afresh."""
    dt, n, k3 = 2e-3, 6000, 4e4
    f, t = force(n, dt), np.arange(n) * dt

    def rhs(s: float, y: Array) -> list[float]:
        return [y[1], np.interp(s, t, f) - 3 * y[1] - k3 * y[0] ** 3]

    want = solve_ivp(rhs, (0, t[-1]), [0.0, 0.0], t_eval=t, rtol=1e-9, atol=1e-11, max_step=dt).y[1]
    rec = recording(
        "mechanical_axis", dt, {"force": f}, {"velocity": want}, AXIS, {"mass": 1.0, "damping": 3.0, "stiffness": 0.0}
    )
    twin = make(rec)
    place = sites(twin, rec, EFFECTS["cubic_stiffness"])[0]
    size = n // pieces
    view = View(rec, tuple((k * size, (k + 1) * size - 100) for k in range(pieces)), 10)
    base = Model(twin)
    (spring,) = Model(twin, [prepare(base, view, base.start(rec), place)]).placed
    model = Model(twin, [spring])
    theta = model.carry(base, base.start(rec), rec)
    names = [p.name for p in model.parameters]
    for name, value in (("cubic", k3), ("quadratic", 0.0), ("linear", 0.0)):
        theta[names.index(f"cubic_stiffness[velocity].{name}")] = value
    got = model.simulate(view, theta)["velocity"]
    assert np.max(np.abs(got - view.measured("velocity"))) < 5e-3 * np.ptp(want)


def test_cluster_against_rigid_body() -> None:
    dt, n = 1e-3, 2000
    t = np.arange(n) * dt
    w = np.stack([np.sin(5 * t), 0.5 * np.cos(3 * t), np.sin(7 * t + 1)], axis=1)
    alpha = np.stack([5 * np.cos(5 * t), -1.5 * np.sin(3 * t), 7 * np.cos(7 * t + 1)], axis=1)
    f = np.stack([np.sin(t), np.cos(t), 9.8 + 0 * t], axis=1)
    r = np.array([0.1, -0.2, 0.05])
    inputs = {f"specific_force_{a}": f[:, i] for i, a in enumerate("xyz")}
    inputs |= {f"angular_rate_{a}": w[:, i] for i, a in enumerate("xyz")}
    noise = np.random.default_rng(0).standard_normal(n)
    rec = recording(
        "accelerometer_cluster", dt, inputs, {"accel_1x": noise, "accel_1z": noise}, {},
        {"positions_m": {"1": list(r)}},
    )  # fmt: skip
    want = f + np.cross(alpha, r)
    got = as_given(rec)
    np.testing.assert_allclose(got["accel_1x"], want[:, 0], atol=2e-4)
    np.testing.assert_allclose(got["accel_1z"], want[:, 2], atol=2e-4)
    effect = EFFECTS["centripetal_acceleration"]
    model = Model(make(rec), sites(make(rec), rec, effect))
    theta = model.start(rec)
    theta[-1] = 1.0
    full = want + np.cross(w, np.cross(w, r))
    np.testing.assert_allclose(model.simulate(View.whole(rec), theta)["accel_1z"][2:-2], full[2:-2, 2], atol=2e-4)


SQUARER = """
class Squarer:
    def simulate(self, inputs, parameters):
        return {"y": parameters["gain"] * inputs["u"] ** 2}
"""


def test_user_twin_from_an_entry_point(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "squarer_of_hers.py").write_text(SQUARER)
    monkeypatch.syspath_prepend(str(tmp_path))
    entry = EntryPoint("squarer", "squarer_of_hers:Squarer", "micron.twins")
    module = importlib.import_module("tools.mismatch.twins.core")
    monkeypatch.setattr(module, "find_user_kind", {"squarer": entry}.get)
    u = np.linspace(-1, 1, 60)
    rec = recording("squarer", 0.1, {"u": u}, {"y": u}, {}, {"gain": 3.0, "label": "x"})
    with pytest.raises(NotTrusted, match="squarer_of_hers"):
        as_given(rec)
    trust_package(entry.value)
    np.testing.assert_allclose(as_given(rec)["y"], 3 * u**2)
    broken = recording("squarer", 0.1, {"u": u}, {"y": u, "z": u}, {}, {"gain": 3.0})
    with pytest.raises(RecordingError, match="returned no output 'z'"):
        as_given(broken)
    assert "squarer_of_hers" not in sys.modules


def test_fmu_needs_its_extra(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "fmpy", None)
    (tmp_path / "m.fmu").write_bytes(b"")
    u = np.ones(60)
    rec = recording("fmu", 0.1, {"u": u}, {"y": u}, {}, {"path": str(tmp_path / "m.fmu")})
    with pytest.raises(RecordingError, match="extra 'fmu'"):
        make(replace(rec, path=tmp_path / "made.toml"))


def test_linear_kernels_equal_python() -> None:
    d = discretise(np.array([[0.0, 1.0], [-30.0, -2.0]]), np.array([0.0, 1.0]), 0.01, "linear")
    u = np.random.default_rng(0).standard_normal(80)
    starts, x0 = np.array([0, 40]), np.array([[0.1, 0.0], [0.0, 1.0]])
    states = run_states(d.ad, d.g0, d.g1, u, x0, starts)
    np.testing.assert_allclose(states, run_states.py_func(d.ad, d.g0, d.g1, u, x0, starts), atol=1e-14)
    c = np.array([1.0, 0.5])
    args = (d.ad, d.g0, d.g1, c, u, starts)
    np.testing.assert_allclose(run_output(*args), run_output.py_func(*args), atol=1e-14)
    rows = (
        np.array([0.2, 0.05, 0.1, 0.3, 0.02, 0.0, 0.0, 1.0]),
        np.array([3.0, 0.5, 2.0, 1.0, 0.1, 0.2, 0.4, 0.05, 0.1, 0.3, 0.15]),
        np.array([0.1, 0.2, 0.1, 0.0, 0.05, 0.3, -0.1]),
    )
    assert [row.size for row in rows] == [FRICTION, SPRING, COGGING]
    more = (np.array([0.01]), np.array([2.0]))
    cp, cv = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    for dry, stiff in ((True, 0.0), (False, 60.0)):
        rows[0][5] = stiff
        body = Body(d.ad, d.g0, d.g1, cp, cv, False, 2, 0.005, dry)
        args = (body, Rows(*rows, *more), u, x0, starts, np.array([40, 80]))
        np.testing.assert_allclose(run_feedback(*args), run_feedback.py_func(*args), atol=1e-13)


def test_free_responses_are_kept_while_they_are_felt() -> None:
    d = discretise(np.array([[0.0, 1.0], [-400.0, -16.0]]), np.array([0.0, 1.0]), 0.01, "linear")
    row, measured = np.array([1.0, 0.0]), {"y": np.zeros(5000)}
    run = Run(0.01 * np.arange(5000), 0.01, {}, (), measured, (0,), 20, {})
    state = start_state(d.ad, {"y": row}, run)
    assert state.free["y"][0].shape[0] < 600
    x0 = np.array([[0.3, -2.0]])
    whole = free_response(d.ad, row, 5000) @ x0[0]
    np.testing.assert_allclose(state.response(x0, "y", 5000), whole, atol=1e-12)


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_states_of_every_order_are_those_of_the_recursion(order: int) -> None:
    rng = np.random.default_rng(order)
    a = rng.standard_normal((order, order)) - 3 * np.eye(order)
    d = discretise(a, rng.standard_normal(order), 0.05, "linear")
    u, starts, x0 = rng.standard_normal(40), np.array([0, 25]), rng.standard_normal((2, order))
    want = np.empty((40, order))
    for k in range(40):
        if k in starts:
            x = x0[starts.tolist().index(k)]
        else:
            x = d.ad @ x + d.g0 * u[k - 1] + d.g1 * u[k]
        want[k] = x
    np.testing.assert_allclose(run_states(d.ad, d.g0, d.g1, u, x0, starts), want, atol=1e-12)


def test_a_free_response_is_computed_no_further_than_it_can_be_felt() -> None:
    for poles in ([0.9, 0.9, 0.9], [0.999], [0.5, -0.99]):
        ad = np.diag(poles) + np.diag(np.ones(len(poles) - 1), 1)  # a Jordan chain where they repeat
        n = felt_at_most(ad, 100_000)
        free = np.abs(free_response(ad, np.ones(len(poles)), 100_000)).max(axis=1)
        assert free[n:].max(initial=0.0) < 1e-12 * free.max()
        assert n < 100_000
    assert felt_at_most(np.array([[1.0]]), 777) == 777
    assert felt_at_most(np.array([[np.inf, 0.0], [0.0, np.nan]]), 777) == 777  # a trial beyond all numbers
