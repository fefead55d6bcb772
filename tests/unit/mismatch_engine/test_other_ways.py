"""Second effects that the first choice hid: steps by their edges, other beginnings, one physics on every output."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sim_devices.physics.catalogue import EFFECTS
from sim_devices.physics.effect import Context
from sim_devices.physics.lines import mean_spread
from sim_devices.physics.spikes import SPIKES
from sim_devices.physics.step_shift import STEP_SHIFT, edges
from tests.unit.mismatch_engine.cases import RATE, named, recording, wave
from tools.mismatch.engine import workers
from tools.mismatch.engine.pose import prepared
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.projected import Projected
from tools.mismatch.engine.screen import places
from tools.mismatch.engine.split import Split
from tools.mismatch.engine.vary import added
from tools.mismatch.simulate_sites import sites
from tools.mismatch.simulate_start import moved
from tools.mismatch.twins.make import make

STACK = {"gain_um_per_V": 0.125, "offset_um": 0.0}
DT = 1 / RATE


def stack(y: np.ndarray, u: np.ndarray):
    return recording("piezo_stack", {"command": u}, {"displacement": y}, STACK)


def context(e: np.ndarray, **signals: np.ndarray) -> Context:
    return replace(Context(np.arange(e.size) * DT, DT, signals, "displacement"), everywhere=e)


def swinging(n: int = 3000) -> np.ndarray:
    """Slow swings with white noise of rms 1 (n,), as a base that is off leaves."""
    k = np.arange(n)
    return 30 * np.sin(2 * np.pi * k / 900) + np.random.default_rng(4).standard_normal(n)


def test_steps_are_read_off_their_edges_however_a_base_swings() -> None:
    e = swinging()
    for at, height in ((700, 25.0), (1500, -30.0), (2200, 22.0)):
        e[at:] += height
    found, above = edges(e, context(e))
    assert found == [700, 1500, 2200]
    assert above > 3.0
    by_edge = STEP_SHIFT.variants[0]
    assert by_edge.test is not None
    assert by_edge.test(e, e, context(e)).p_value < 1e-5


@pytest.mark.parametrize("memory", [0.0, 0.9])
def test_heavy_tails_are_no_edges(memory: float) -> None:
    test = STEP_SHIFT.variants[0].test
    assert test is not None
    sure = 0
    for seed in range(40):
        e = np.random.default_rng(seed).standard_t(4, 3000)
        for k in range(1, e.size):
            e[k] += memory * e[k - 1]
        sure += test(e, e, context(e)).p_value < 1e-3
    assert sure <= 1


def test_an_answer_to_a_jump_of_the_input_is_no_step() -> None:
    e, u = swinging(), np.zeros(3000)
    u[1000:] = 1.0
    e[1000:] += 25.0
    assert edges(e, context(e, command=u))[0] == []
    assert edges(e, context(e))[0] == [1000]


def test_a_step_beside_a_curve_is_no_walk() -> None:
    n = 1500
    rng = np.random.default_rng(5)
    u = 50 + 40 * wave(rng, n)
    y = 0.125 * u + 4e-4 * (u - 50) ** 2 + 0.5 * ((np.arange(n) > 500) + 1.0 * (np.arange(n) > 1100))
    names = ("static_nonlinearity", "step_shift", "random_walk", "thermal_drift")
    assert named(stack(y + 0.01 * rng.standard_normal(n), u), names) == {"static_nonlinearity", "step_shift"}


def test_one_step_among_heavy_tails_is_no_walk() -> None:
    n = 3000
    rng = np.random.default_rng(12)
    u = np.repeat(rng.uniform(10, 90, 25), n // 25)
    y = 0.125 * u + 0.15 * (np.arange(n) > 1330) + 0.02 * rng.standard_t(4, n)
    assert named(stack(y, u), ("step_shift", "random_walk")) == {"step_shift"}


def test_bursts_that_all_lie_in_what_is_held_out_are_seen() -> None:
    e = np.random.default_rng(6).standard_normal(3000)
    for at in (400, 1400, 2500):
        e[at] += 300.0
        e[at + 1] -= 300.0
    keep = np.ones(e.size, np.bool_)
    for at in (400, 1400, 2500):
        keep[at - 50 : at + 50] = False
    assert SPIKES.test is not None
    assert SPIKES.test(e, np.where(keep, e, 0.0), replace(context(e), mask=keep)).p_value < 1e-7


def test_one_command_of_several_may_be_late() -> None:
    n = 400
    two = {s: wave(np.random.default_rng(i), n) for i, s in enumerate(("force", "push"))}
    matrix = {"A": [[-20.0]], "B": [[20.0, 5.0]], "C": [[1.0]], "D": [[0.0, 0.0]], "x0": [0.0], "y0": [0.0]}
    rec = recording("state_space", two, {"y": np.zeros(n)}, matrix)
    late = sites(make(rec), rec, EFFECTS["dead_time"])
    assert {(p.site, p.target) for p in late} == {("output", "y"), ("input", "force"), ("input", "push")}
    assert {p.stage for p in late if p.site == "input"} <= {"amplifier", "actuator"}


def test_what_a_sensor_adds_is_not_the_course_of_the_plant() -> None:
    n = 1200
    rng = np.random.default_rng(9)
    u = 50 + 40 * wave(rng, n)
    y = 0.125 * u + 2.0 * (np.arange(n) >= 600) + 0.01 * rng.standard_normal(n)
    problem, _, base = prepared(stack(y, u), 0.3, 0, False)
    place = places(problem, [EFFECTS["step_shift"]], ())[0]
    step = added(problem, base, place)
    view = problem.fit_view
    plant = moved(step.model, view, step.theta, "displacement")
    line = np.polynomial.Polynomial.fit(u, plant, 1)
    assert np.median(np.abs(plant - line(u))) < 0.02
    assert moved(base.model, view, base.theta, "displacement") is view.recording.outputs["displacement"]


def test_a_trial_that_runs_away_has_no_cost() -> None:
    rng = np.random.default_rng(10)
    u = 50 + 40 * wave(rng, 600)
    problem, _, base = prepared(stack(0.125 * u + 0.02 * rng.standard_normal(u.size), u), 0.3, 0, False)
    projected = Projected(problem, base.model, problem.twin.outputs, 500)
    projected.weight["displacement"] = np.full(projected.rows.size, np.nan)
    residual, _ = projected.evaluate(base.theta)
    assert math.isinf(float(residual @ residual))


def test_spread_of_a_mean_of_alike_neighbours() -> None:
    rng = np.random.default_rng(11)
    means, said = [], []
    for _ in range(400):
        e = rng.standard_normal(24)
        for k in range(1, e.size):
            e[k] += 0.6 * e[k - 1]
        means.append(e.mean())
        said.append(mean_spread(e - e.mean(), np.ones(e.size)))
    assert np.mean(said) == pytest.approx(np.std(means), rel=0.35)
    assert mean_spread(np.zeros(5), np.ones(5)) == 0.0


def _twice(x: float) -> float:
    return 2 * x


def test_pieces_in_processes_and_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    rec = stack(np.zeros(100), np.zeros(100))
    problem = Problem(rec, make(rec), Split(100, ((0, 100),), (), (), ()), 0, 0)
    told: list[int] = []
    work = [(float(i),) for i in range(5)]
    one = workers.mapped(problem, _twice, work, 1, tell=told.append)
    monkeypatch.setattr(workers, "LEAST_SAMPLES", 0)
    two = workers.mapped(problem, _twice, work, 2)
    assert one == two == [0.0, 2.0, 4.0, 6.0, 8.0]
    assert told == [1, 2, 3, 4, 5]


def _counted(piece: int, shared: dict[str, Any], half: float) -> tuple[float, int, int]:
    shared["pieces"] += 1
    return piece + float(shared["ramp"][-1]) + half, os.getpid(), shared["pieces"]


def test_a_worker_unpacks_once_what_all_pieces_share(monkeypatch: pytest.MonkeyPatch) -> None:
    rec = stack(np.zeros(100), np.zeros(100))
    problem = Problem(rec, make(rec), Split(100, ((0, 100),), (), (), ()), 0, 0)
    monkeypatch.setattr(workers, "LEAST_SAMPLES", 0)
    shared = {"pieces": 0, "ramp": np.arange(300_000.0)}  # more than joblib sends by pipe
    found = workers.mapped(problem, _counted, [(i, shared, 0.5) for i in range(20)], 2)
    assert [f[0] for f in found] == [i + 299_999.5 for i in range(20)]
    counts = {pid: [n for _, p, n in found if p == pid] for _, pid, _ in found}
    assert os.getpid() not in counts
    assert all(sorted(n) == list(range(1, len(n) + 1)) for n in counts.values())
