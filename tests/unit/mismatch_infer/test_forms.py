"""Data that do not tell two laws of friction apart leave its level uncertain by both."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numba
import numpy as np
import pytest

from sim_devices.physics.catalogue import EFFECTS
from sim_devices.physics.effect import Array
from tests.unit.mismatch_engine.cases import recording
from tools.mismatch.engine.pose import Ended
from tools.mismatch.infer import diagnose, run

RATE_HZ, SLIDING_N = 500.0, 0.6


@numba.njit
def slid(force: Array) -> Array:
    """Return the course (n,) of a mass of 1 kg on a spring of 400 N/m; its friction falls as 1 / (1 + (v/vs)^2).

    It sticks below the friction at rest, 1.2 N; 40 steps a sample.
    """
    out = np.empty(force.size)
    h = 1.0 / (RATE_HZ * 40)
    x, v = 0.0, 0.0
    for k in range(force.size):
        out[k] = x
        for _ in range(40):
            push = force[k] - 8.0 * v - 400.0 * x
            if v == 0.0 and abs(push) <= 2.0 * SLIDING_N:
                continue
            way = np.sign(v) if v != 0.0 else np.sign(push)
            after = v + h * (push - way * SLIDING_N * (1.0 + 1.0 / (1.0 + (v / 0.02) ** 2)))
            v = 0.0 if v * after < 0.0 else after
            x += h * v
    return out


def level(monkeypatch: pytest.MonkeyPatch, *, alone: bool) -> tuple[float, float]:
    """Return the interval of the level of sliding; ``alone``: without the values of other forms."""
    rng = np.random.default_rng(4)
    t = np.arange(5000) / RATE_HZ
    force = 6.0 * np.sin(2 * np.pi * 0.7 * t) + 4.0 * np.sin(2 * np.pi * 2.3 * t + 1.0)
    y = slid(force)
    y = y + 0.003 * float(np.std(y)) * rng.standard_normal(y.size)
    given: dict[str, Any] = {"mass": 1.0, "damping": 8.0, "stiffness": 400.0}
    rec = recording("mechanical_axis", {"force": force}, {"position": y}, given, rate_hz=RATE_HZ)
    with monkeypatch.context() as patch:
        if alone:
            patch.setattr(run, "forms_as_good", lambda *_: ())
        (found,) = diagnose(rec, jobs=1, effects=[EFFECTS["stribeck_friction"]]).physics
    return found.parameters["coulomb_forward"].ci95


def test_the_interval_of_a_level_holds_the_law_that_was_not_named(monkeypatch: pytest.MonkeyPatch) -> None:
    low, high = level(monkeypatch, alone=False)
    narrow = level(monkeypatch, alone=True)
    assert low <= SLIDING_N <= high
    assert high - low > narrow[1] - narrow[0]


def test_of_two_forms_the_one_is_reported_that_leaves_less_in_the_whole_run(monkeypatch: pytest.MonkeyPatch) -> None:
    def scored(form: str, left: float) -> SimpleNamespace:
        placed = SimpleNamespace(effect=SimpleNamespace(name="coulomb_friction"), site="feedback", target="x")
        return SimpleNamespace(key=form, placed=(placed,), fitted=SimpleNamespace(form=form, left=left))

    short, whole, doubted = scored("bristles", 3.0), scored("plain", 2.0), scored("smooth", 1.0)
    store = SimpleNamespace(base=SimpleNamespace(fitted=None), sets={s.key: s for s in (short, whole, doubted)})
    posed = SimpleNamespace(problem=None)
    monkeypatch.setattr(run, "run_through", lambda _, base, fitted, held: Ended(base, fitted, left=fitted.left))
    monkeypatch.setattr(run, "doubts_of", lambda _, fitted: [1] if fitted.form == "smooth" else [])
    chosen, ended = run.best_form(posed, store, short, 0.3)  # type: ignore[arg-type]
    assert (chosen, ended.fitted) == (whole, whole.fitted)
    monkeypatch.setattr(run, "run_through", lambda _, base, fitted, held: Ended(base, fitted))
    assert run.best_form(posed, store, short, 0.3)[0] is short  # type: ignore[arg-type]
