"""Estimation holds: what the data do not determine stays where the engineer put it, and no figure runs away."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_engine.cases import recording, stack, wave
from tools.errors import RecordingError
from tools.mismatch import notebook
from tools.mismatch.engine.exported import raw_values, without_events
from tools.mismatch.engine.fit import fit, fit_base, moved_a_little, slopes
from tools.mismatch.engine.intervals import uncertainty
from tools.mismatch.engine.pose import nominated, prepared
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.projected import Projected
from tools.mismatch.engine.reduce import fitted_part, is_long
from tools.mismatch.engine.score import fit_rms, held_rms
from tools.mismatch.engine.screen import Regression, bend, one_step, places
from tools.mismatch.engine.split import own_split
from tools.mismatch.engine.trust import to_search
from tools.mismatch.infer import diagnose
from tools.mismatch.infer.constants import learned
from tools.mismatch.infer.search import look
from tools.mismatch.recording import Recording
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_start import prepare
from tools.mismatch.simulate_view import view_run
from tools.mismatch.twins.make import make
from tools.mismatch.twins.opaque import opaque_twin

Array = np.ndarray
N = 1500


def two_tanks(seed: int = 0) -> Recording:
    """Two tanks with an outflow that grows with the root of the level; the twin is linear, with a constant state 1."""
    pump = 4.0 + 2.5 * wave(np.random.default_rng(seed), N, 0.3, 3.0)
    dt, x = 1 / 500, np.array([4.0, 4.0])
    level = np.empty(N)
    for i in range(N):
        level[i] = x[1]
        for _ in range(4):
            upper, lower = 12.0 * np.sqrt(np.maximum(x, 1e-9))
            x = x + dt / 4 * np.array([6.0 * pump[i] - upper, upper - lower])
    level += 0.01 * np.random.default_rng(seed + 1).standard_normal(N)
    a = [[-3.0, 0.0, -12.0], [3.0, -3.0, 0.0], [0.0, 0.0, 0.0]]
    given = {"A": a, "B": [[6.0], [0.0], [0.0]], "C": [[0.0, 1.0, 0.0]], "x0": [4.0, 4.0, 1.0]}
    return recording("state_space", {"pump": pump}, {"level": level}, given)


def test_a_state_that_is_the_constant_one_leaves_every_figure_in_the_range_of_the_data() -> None:
    rec = two_tanks()
    problem, raw, base = prepared(rec, 0.3, 0, False)
    size = float(np.max(np.abs(rec.outputs["level"])))
    for p, v in zip(base.model.parameters, base.theta, strict=True):
        assert abs(v) < 100 * max(size, abs(p.scale)), (p.name, v)
    assert problem.floors["level"].rms < size
    assert held_rms(problem, base)["level"] <= held_rms(problem, raw)["level"]
    assert fit_rms(problem, base)["level"] <= fit_rms(problem, raw)["level"]


def test_a_late_command_of_a_program_that_keeps_what_happened_first_is_late_before_it() -> None:
    """Behind an integrator a late command is no late output: what it did before it was late stays in the angle."""
    rng = np.random.default_rng(4)
    u, dt, late = 1.0 + wave(rng, 1200, 0.5, 4.0), 0.01, 2.3

    def turned(x: Array, step: float) -> Array:
        return 5.0 * step * np.concatenate([[0.0], np.cumsum(0.5 * (x[1:] + x[:-1]))])

    def simulate(inputs: Mapping[str, Array], parameters: Mapping[str, float], dt: float) -> Array:
        return parameters["gain"] / 5.0 * turned(inputs["volts"], dt)

    t = np.arange(u.size)
    fine = np.arange(0, u.size, 0.05)
    angle = np.interp(t, fine, turned(np.interp(fine - late, t, u), 0.05 * dt))
    angle += 1e-3 * rng.standard_normal(u.size)
    rec = notebook.Recording({"volts": u}, {"angle": angle}, dt).with_twin(notebook.Twin(simulate, {"gain": 5.1}))
    report = diagnose(rec, effects=[EFFECTS[n] for n in ("dead_time", "rate_dependent_hysteresis", "first_order_lag")])
    assert [(p.name, p.site) for p in report.physics] == [("dead_time", "input")]
    assert report.physics[0].parameters["delay_s"].value == pytest.approx(late * dt, abs=1e-4)


def own_problem(rec: Recording, call: Any) -> Problem:
    """The problem of a recording whose twin is a Python function."""
    twin = opaque_twin(rec, call, "a test")
    inputs = np.column_stack([*rec.inputs.values()])
    return Problem(rec, twin, own_split(inputs), 0, 0)


def geared(inputs: Mapping[str, Array], parameters: Mapping[str, Any]) -> Mapping[str, Array]:
    """The gear cancels but for rounding; only the product of both gains matters."""
    gear = parameters["gear"]
    return {"y": parameters["k1"] * parameters["k2"] * (gear * inputs["u"]) / gear + parameters["offset"]}


@pytest.mark.parametrize("gear", [3.0, -0.02, 1e5])
def test_a_parameter_that_no_output_depends_on_stays_as_given(gear: float) -> None:
    rng = np.random.default_rng(3)
    u = wave(rng, N)
    given: dict[str, object] = {"k1": 2.0, "k2": 0.5, "offset": 0.1, "gear": gear}
    rec = recording("own", {"u": u}, {"y": 1.7 * u + 0.3 + 0.01 * rng.standard_normal(N)}, given)
    problem = own_problem(rec, geared)
    fitted = fit_base(problem)
    found = dict(zip(given, fitted.theta.tolist(), strict=True))
    assert found["gear"] == pytest.approx(gear, rel=1e-3)
    assert found["k1"] * found["k2"] == pytest.approx(1.7, rel=0.01)
    # the product says nothing about its factors: each stays near what was believed
    assert 0.5 < found["k1"] / 2.0 < 2.0
    assert 0.5 < found["k2"] / 0.5 < 2.0
    assert found["offset"] == pytest.approx(0.3, abs=0.01)
    # nor does the interval of the gear claim that it is known
    half = 1.96 * uncertainty(problem, fitted).deviations()
    assert half[list(given).index("gear")] > abs(gear)
    assert half[list(given).index("offset")] < 0.01


def test_a_refit_that_loses_on_held_out_data_is_not_used() -> None:
    """The held-out half has another gain than the fitted one; the engineer's own is the right one there."""
    rng = np.random.default_rng(5)
    u = wave(rng, N)
    y = np.where(np.arange(N) < N // 2, 3.0, 1.0) * u + 0.01 * rng.standard_normal(N)
    rec = recording("piezo_stack", {"command": u}, {"displacement": y}, {"gain_um_per_V": 1.0, "offset_um": 0.0})
    rec = replace(rec, split=replace(rec.split, fit=(0, N // 2), test=(N // 2, N)))
    problem, raw, base = prepared(rec, 0.3, 0, False)
    assert held_rms(problem, base) == held_rms(problem, raw)
    np.testing.assert_array_equal(base.theta, raw.theta)


def test_offsets_are_solved_again_when_the_events_are_left_out_of_a_twin() -> None:
    problem, _, base = prepared(stack(np.random.default_rng(1), "step_shift", 30.0), 0.3, 0, False)
    place = places(problem, (EFFECTS["step_shift"],), ())[0]
    candidate = one_step(problem, base, place, bend(problem, base))
    fitted = fit(problem, Model(problem.twin, (candidate.placed,)), candidate.starts)
    written = without_events(problem, fitted)
    assert written.model.placed == ()
    assert raw_values(written) == {}
    names = [p.name for p in written.model.parameters]
    offset = names.index("offset_um")
    # beside the step the offset is the level before it; without it, what leaves no mean
    left = written.residual["displacement"][problem.fit_rows]
    assert abs(float(np.mean(left))) < 1e-6 * float(np.std(left))
    assert abs(fitted.theta[offset] - written.theta[offset]) > 5 * problem.floors["displacement"].rms
    assert without_events(problem, base) is base


def test_a_search_on_parts_sees_nothing_of_an_official_test() -> None:
    rec = two_tanks()
    assert fitted_part(rec).n == N
    assert fitted_part(replace(rec, split=replace(rec.split, test=(1000, 1200)))).n == 1000
    part = fitted_part(replace(rec, split=replace(rec.split, fit=(100, 900), test=(1000, 1200))))
    np.testing.assert_array_equal(part.outputs["level"], rec.outputs["level"][100:900])
    assert part.split.test is None


def test_parts_of_a_long_record_nominate_what_the_whole_decides_on() -> None:
    rng = np.random.default_rng(2)
    n = 90_000
    u = 50 + 40 * np.concatenate([wave(rng, 6000) for _ in range(15)])
    z = 0.12 * np.minimum(u, 75.0) + 0.02 * rng.standard_normal(n)
    rec = recording("piezo_stack", {"command": u}, {"displacement": z}, {"gain_um_per_V": 0.12, "offset_um": 0.0})
    assert is_long(rec, make(rec))
    tried = tuple(EFFECTS[e] for e in ("saturation", "mains_interference", "creep", "spikes"))
    effects, hints = nominated(rec, 0.3, 0, tried, partial(look, learned(), 1, None))
    names = [e.name for e in effects]
    assert "saturation" in names
    assert "mains_interference" not in names
    assert "saturation" in [h.placed.effect.name for h in hints], "the whole begins where the part ended"


def test_slopes_on_the_outputs_that_move_are_those_of_all_outputs() -> None:
    rng = np.random.default_rng(11)
    force = np.column_stack([wave(rng, 1200) for _ in "xyz"])
    volts = 2.5 + force - 0.1 * np.clip(force, -0.3, 0.3) + 2e-3 * rng.standard_normal(force.shape)
    made = recording(
        "accelerometer",
        {f"specific_force_{a}": force[:, i] for i, a in enumerate("xyz")},
        {f"voltage_{a}": volts[:, i] for i, a in enumerate("xyz")},
        {"bias_V": 2.5, "scale_V_per_g": 1.0},
    )
    problem, _, base = prepared(made, 0.3, 0, False)
    effects = [EFFECTS[n] for n in ("dead_zone", "channel_delay", "first_order_lag", "misalignment")]
    tried = places(problem, effects, ())
    # one form of each: two dead zones in a row may leave parameters that move nothing
    one = [p for p in tried if p.effect.kind == "add" and p.target.endswith(("_x", "_y"))]
    shared = next(p for p in tried if p.effect.name == "first_order_lag" and len(p.outputs) == 3)
    model = Model(problem.twin, [prepare(Model(problem.twin), problem.fit_view, base.theta, p) for p in (*one, shared)])
    theta = model.carry(base.model, base.theta, made)
    projected = Projected(problem, model, problem.twin.outputs, 500)
    residual, theta = projected.evaluate(theta)
    alone = [len(model.moved_by(i)) for i in projected.free]
    assert min(alone) == 1
    assert max(alone) == 3
    found = slopes(projected, theta, residual)
    for c, i in enumerate(projected.free):
        moved = moved_a_little(model, theta, i)
        h = to_search(model.parameters[i], moved[i]) - to_search(model.parameters[i], theta[i])
        true = (projected.evaluate(moved)[0] - residual) / h
        assert found[:, c] == pytest.approx(true, rel=1e-6, abs=1e-6 * np.abs(true).max())
        assert np.any(true != 0.0)


def test_a_regression_in_blocks_is_that_of_the_whole() -> None:
    rng = np.random.default_rng(4)
    blocks = [rng.standard_normal((40, 6)) for _ in range(3)]
    for i, block in enumerate(blocks):
        block[:, [j for j in range(1, 6) if j != i + 1]] = 0.0
    blocks[1][:, 5] = blocks[1][:, 2]  # one column twice
    whole = np.concatenate(blocks)
    y = rng.standard_normal((120, 2))
    true = y - whole @ np.linalg.lstsq(whole, y, rcond=1e-9)[0]
    found = Regression(blocks)
    assert found.less(y) == pytest.approx(true, abs=1e-12)
    assert found.less(y[:, 0]) == pytest.approx(true[:, 0], abs=1e-12)


@pytest.mark.parametrize("diverged", [1e180, np.inf, np.nan])
def test_a_derivative_that_diverged_is_left_out_of_a_regression(diverged: float) -> None:
    rng = np.random.default_rng(2)
    one, y = rng.standard_normal((50, 1)), rng.standard_normal(50)
    wide = np.column_stack([one, np.full(50, diverged)])
    assert Regression([wide]).less(y) == pytest.approx(Regression([one]).less(y))


def lever(inputs: Mapping[str, Array], parameters: Mapping[str, Any]) -> Mapping[str, Array]:
    """Micrometres out of volts, bent by the angle, and refused beyond the stop."""
    if np.max(np.abs(inputs["u"])) > parameters["stop"]:
        raise RecordingError("made here: beyond the stop")
    return {"y": parameters["arm"] * np.sin(parameters["turn"] * inputs["u"])}


@pytest.mark.parametrize("refused", [False, True])
def test_a_change_goes_through_a_program_as_its_derivative_says(refused: bool) -> None:
    rng = np.random.default_rng(6)
    u = np.clip(wave(rng, N), -1.0, 1.0)
    stop = float(np.max(np.abs(u))) + (0.001 if refused else 0.1)
    given: dict[str, object] = {"arm": 260.0, "turn": 1.1, "stop": stop}
    rec = recording("own", {"u": u}, {"y": 260.0 * np.sin(1.1 * u)}, given)
    problem = own_problem(rec, lever)
    run = view_run(problem.twin, problem.view)
    carry = problem.twin.through(run, "u", np.array([260.0, 1.1, stop]), "y")
    assert carry is not None
    assert not np.any(carry(np.zeros(N)))
    change = 20.0 * (1.5 + np.cos(0.02 * np.arange(N))) * np.sign(u)
    expected = 286.0 * np.cos(1.1 * u) * change
    if refused:  # what the program refuses moves nothing
        expected = np.zeros(N)
    np.testing.assert_allclose(carry(change), expected, atol=0.02 * 286.0 * 50.0 * bool(np.any(expected)))


def test_a_slow_command_of_a_bent_program_is_creep_before_it() -> None:
    """The weights of an effect at the input are in volts; the mismatch is in micrometres."""
    rng = np.random.default_rng(2)
    dt, step = 0.01, rng.uniform(-0.9, 0.9, 12)
    u = np.repeat(step, 200)
    slow = np.convolve(np.diff(u, prepend=u[0]), np.log10(1.0 + np.arange(u.size) * dt / 0.05))[: u.size]

    def simulate(inputs: Mapping[str, Array], parameters: Mapping[str, float], dt: float) -> Array:
        return parameters["arm"] * np.sin(parameters["turn"] * inputs["u"])

    lift = 260.0 * np.sin(1.1 * (u + 0.05 * slow)) + 0.5 * rng.standard_normal(u.size)
    rec = notebook.Recording({"u": u}, {"lift": lift}, dt).with_twin(
        notebook.Twin(simulate, {"arm": 255.0, "turn": 1.12})
    )
    report = diagnose(rec, effects=[EFFECTS[n] for n in ("creep", "backlash", "hysteresis", "static_nonlinearity")])
    assert [(p.name, p.site) for p in report.physics] == [("creep", "input")]
    assert report.verdict == "missing_physics"
