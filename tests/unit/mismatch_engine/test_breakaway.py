"""A motor with breakaway: missing friction bends its time constant, and a rugged misfit hides the best fit."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_engine.cases import recording
from tools.mismatch.engine.fit import Fit, ground_of
from tools.mismatch.engine.pose import prepared
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.trust import fit_loss
from tools.mismatch.infer.constants import learned
from tools.mismatch.infer.search import Search
from tools.mismatch.recording import Recording

MOTOR = Path(__file__).parents[3] / "examples" / "motor" / "motor.py"
SEED = 141693172
"""A motor whose breakaway was missed: re-fitted without friction, its time constant ran to 24 us from 67 ms."""
TWIN: dict[str, Any] = {
    "states": {"angle": "rad", "speed": "rad/s"},
    "equations": {"angle": "speed", "speed": "(gain * command - speed) / lag"},
    "units": {"gain": "1/s", "lag": "s"},
}


def example() -> ModuleType:
    """The example's own motor, which is no package."""
    spec = importlib.util.spec_from_file_location("example_motor", MOTOR)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@cache
def motor(variant: str) -> Recording:
    made = example()
    drawn = made.drawn(SEED)
    columns = made.record(drawn, variant)
    twin = {**TWIN, "gain": drawn.told_speed_per_V, "lag": drawn.told_time_constant_s}
    return recording(
        "ode", {"command": columns["command_V"]}, {"angle": columns["angle_rad"]}, twin, rate_hz=drawn.rate_hz
    )


@cache
def posed(variant: str) -> tuple[Problem, Fit]:
    problem, _, base = prepared(motor(variant), 0.3, 0, False)
    return problem, base


def value(fit: Fit, name: str) -> float:
    return float(fit.theta[[p.name for p in fit.model.parameters].index(name)])


def test_a_time_constant_is_searched_by_its_size_and_a_gain_is_not() -> None:
    problem, base = posed("nothing")
    searched = {p.name: (p.log, p.lo, p.hi) for p in base.model.parameters}
    lag = problem.given[[p.name for p in base.model.parameters].index("lag")]
    assert searched["lag"] == (True, lag / 100.0, lag * 100.0)
    assert searched["gain"] == (False, -np.inf, np.inf)


def bent(fit: Fit, name: str, factor: float) -> Fit:
    """The same fit with a parameter that is ``factor`` times as large."""
    theta = fit.theta.copy()
    theta[[p.name for p in fit.model.parameters].index(name)] *= factor
    return replace(fit, theta=theta)


def test_a_base_that_left_the_engineers_values_is_no_ground() -> None:
    problem, base = posed("stribeck")
    far = bent(base, "lag", 0.02)
    assert ground_of(problem, far).theta.tolist() == problem.given.tolist()
    near = replace(base, theta=problem.given.copy())
    assert ground_of(problem, near) is near


def test_a_re_fit_that_leaves_noise_is_the_ground() -> None:
    problem, base = posed("nothing")
    far = bent(base, "lag", 0.02)
    assert ground_of(problem, far) is far


@pytest.mark.slow
def test_breakaway_is_found_though_the_base_is_bent() -> None:
    """The misfit is rugged: bodies stick and slip at other samples for every value that is tried."""
    problem, base = posed("stribeck")
    names = ("stribeck_friction", "coulomb_friction", "backlash", "static_nonlinearity")
    search = Search(problem, base, [EFFECTS[n] for n in names], learned())
    with np.errstate(all="ignore"):
        search.expand(search.store.base)
    best = search.store.ranked()[0]
    assert best.names == {"stribeck_friction"}
    assert fit_loss(problem, best.fitted.residual) < 1.5**2
    coulomb = next(s for s in search.store.ranked() if s.names == {"coulomb_friction"})
    # it contains Coulomb friction
    assert fit_loss(problem, best.fitted.residual) < fit_loss(problem, coulomb.fitted.residual)
    made = example().drawn(SEED)
    assert abs(value(best.fitted, "lag") / made.time_constant_s - 1.0) < 0.05
