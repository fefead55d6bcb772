"""Every name of the contract is there, complete, and its columns agree with its parameters."""

from __future__ import annotations

import re

import numpy as np
import pytest

from sim_devices.physics.catalogue import EFFECTS
from sim_devices.physics.effect import STAGES, Context, Effect
from sim_devices.physics.forces import UNCENTRED
from tests.unit.vocabulary import NAMES
from tools.mismatch.placed import Placed

ALL = [(e.name + "/" + e.kind, e) for one in EFFECTS.values() for e in (one, *one.variants)]


def test_the_vocabulary_is_complete() -> None:
    assert tuple(EFFECTS) == NAMES


def test_every_shape_of_an_effect_has_an_equation_of_its_own() -> None:
    assert len({e.form for _, e in ALL}) == len(ALL)


@pytest.mark.parametrize("effect", [e for _, e in ALL], ids=[n for n, _ in ALL])
def test_an_effect_is_described(effect: Effect) -> None:
    assert effect.summary
    assert effect.equation
    assert re.search(r"\d", effect.source), "a source names an edition, section, page or equation"
    assert effect.excitation
    assert effect.stages
    assert set(effect.stages) <= set(STAGES)
    assert set(effect.confusable_with) <= set(NAMES) - {effect.name}
    if effect.kind in ("linear", "nonlinear"):
        assert effect.apply is not None
    else:
        assert effect.basis is not None
    assert (effect.fill is not None) == (effect.kind == "feedback")


def screened(**facts: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray, Context]:
    """Return a signal (n,), a residual (n,) and what an effect may know of them."""
    rng = np.random.default_rng(0)
    n, dt = 1500, 0.004
    t = np.arange(n) * dt

    def move(k: int) -> np.ndarray:
        return np.sin(2 * np.pi * (0.5 + 0.37 * k) * t + k) + 0.3 * np.sin(2 * np.pi * (3.1 + k) * t)

    names = [f"{v}_{a}" for v in ("specific_force", "angular_rate") for a in "xyz"]
    signals = {s: move(i) for i, s in enumerate([*names, "temperature", "supply", "actuator_current"])}
    x = signals["specific_force_x"]
    y = 2 * x + 0.02 * rng.standard_normal(n) + 0.3 * (t > 3)
    known = {"axis": (0.0,), "position_m": (0.1, 0.2, -0.1), **facts}
    ctx = Context(t, dt, signals, "accel_1x", "accel_1x", "specific_force_x", facts=known, measured=y)
    return x, y - 1.9 * x, ctx


@pytest.mark.parametrize("name", ["linear_loss", "linear_stiffness"])
def test_a_weight_beside_an_effect_is_no_size_of_it(name: str) -> None:
    """The constant beside a loss, or beside a spring without a known rest, proves neither; the other weight does."""
    effect = EFFECTS[name]
    settings = effect.prepare(*screened(**{UNCENTRED: (1.0,)}))
    placed = Placed(effect, "feedback", "x", "mechanics", ("x",), settings)
    assert effect.report is not None
    ((size,),) = effect.vanishes_with
    alone = [{h.name: h.value for h in effect.report(w, settings, 1.0)}[size] for w in np.eye(2)]
    assert placed.weights_beside == 1
    assert alone[0] != 0.0
    assert alone[1] == 0.0


@pytest.mark.parametrize("effect", [e for _, e in ALL], ids=[n for n, _ in ALL])
def test_prepare_guess_and_forward_agree(effect: Effect) -> None:
    x, residual, ctx = screened()
    n = x.size
    settings = effect.prepare(x, residual, ctx)
    assert all(isinstance(v, float) for values in settings.values() for v in values), "settings are plain numbers"
    parts = effect.parts(settings)
    starts = effect.guess(x, residual, ctx, settings)
    assert len(starts) >= 1
    for q in starts:
        assert len(q) == len(parts.nonlinear)
        for p, v in zip(parts.nonlinear, q, strict=True):
            assert p.lo <= v <= p.hi, (p.name, v)
    q = np.array(starts[0], np.float64)
    if effect.kind in ("linear", "nonlinear"):
        assert effect.apply is not None
        out = effect.apply(x, ctx, q, settings)
        assert out.shape == x.shape
    else:
        assert effect.basis is not None
        out = effect.basis(x, ctx, q, settings)
        assert out.shape == (n, len(parts.weights))
    assert np.all(np.isfinite(out))
    if parts.penalty is not None:
        assert parts.penalty.shape[1] == len(parts.weights)
    if effect.report is not None:
        found = effect.report(np.concatenate([q, 0.1 * np.ones(len(parts.weights))]), settings, 2.0)
        assert all(np.isfinite(h.value) for h in found)
    if effect.test is not None:
        signature = effect.test(x, residual, ctx)
        assert 0.0 <= signature.p_value <= 1.0
        assert 0.0 <= signature.share <= 1.0


ALONE = [(n, e) for n, e in ALL if e.driven and e.kind in ("add", "nonlinear") and not e.needs and e.test is None]


@pytest.mark.parametrize("effect", [e for _, e in ALONE], ids=[n for n, _ in ALONE])
def test_an_effect_says_whether_it_is_linear(effect: Effect) -> None:
    """Equal steps of the signal's size make equal changes of what it makes, or they do not."""
    rng = np.random.default_rng(2)
    t = np.arange(1500) * 0.004
    x = np.cumsum(rng.standard_normal(1500)) / 20
    ctx = Context(t, 0.004, {}, "x", "x", measured=x)
    settings = effect.prepare(x, 0.1 * x, ctx)
    q = np.array(effect.guess(x, 0.1 * x, ctx, settings)[0], np.float64)

    def made(v: np.ndarray) -> np.ndarray:
        if effect.basis is not None:
            return effect.basis(v, ctx, q, settings)
        assert effect.apply is not None
        return effect.apply(v, ctx, q, settings)

    straight = np.allclose(made(2 * x) - made(-x), 3 * (made(2 * x) - made(x)), rtol=1e-6, atol=1e-9)
    assert straight == effect.is_linear
