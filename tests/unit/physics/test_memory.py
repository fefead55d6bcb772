"""Memory operators: what they must satisfy exactly, and that they explain shapes made by other equations."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

from hal.arrays import Array
from sim_devices.physics.catalogue import EFFECTS
from sim_devices.physics.effect import Context
from sim_devices.physics.memory import dahl, relays, risen, stops

ONE = np.zeros(1, np.int64)


def context(t: Array, x: Array, y: Array) -> Context:
    return Context(t, float(t[1] - t[0]), {"command": x}, "y", "y", "command", measured=y)


def left_over(name: str, t: Array, x: Array, y: Array) -> float:
    """Rms on left-out blocks after a linear fit of offset, gain and the effect's columns."""
    effect = EFFECTS[name]
    assert effect.basis is not None
    ctx = context(t, x, y)
    residual = y - np.polyval(np.polyfit(x, y, 1), x)
    settings = effect.prepare(x, residual, ctx)
    fit = np.arange(x.size) * 16 // x.size % 3 != 0
    best = np.inf
    for q in effect.guess(x, residual, ctx, settings):
        columns = effect.basis(x, ctx, np.array(q, np.float64), settings)
        a = np.column_stack([np.ones_like(x), x, columns])
        size = np.linalg.norm(a, axis=0)
        gram = (a[fit] / size).T @ (a[fit] / size) + 1e-9 * np.eye(a.shape[1])
        w = np.linalg.solve(gram, (a[fit] / size).T @ y[fit]) / size
        best = min(best, float(np.sqrt(np.mean((y - a @ w)[~fit] ** 2))))
    return best


def loop_height(x: Array, y: Array) -> float:
    """Largest distance of y from its line over x, twice: the height of the loop."""
    return 2 * float(np.max(np.abs(y - np.polyval(np.polyfit(x, y, 1), x))))


def bouc_wen(x: Array, exponent: float) -> Array:
    """dh = dx - (0.8 |dx| |h|^(n-1) h + 0.2 dx |h|^n), in small steps."""
    h = 0.0
    out = np.zeros_like(x)
    for k in range(1, x.size):
        d = (x[k] - x[k - 1]) / 5
        for _ in range(5):
            h += d - 0.8 * abs(d) * abs(h) ** (exponent - 1) * h - 0.2 * d * abs(h) ** exponent
        out[k] = h
    return out


def maxwell_slip(x: Array) -> Array:
    """Four springs, each behind a dry slider."""
    stiffness, limit = np.array([1.0, 0.7, 0.5, 0.3]), np.array([0.1, 0.2, 0.4, 0.6])
    force = np.zeros(4)
    out = np.zeros_like(x)
    for k in range(1, x.size):
        force = np.clip(force + stiffness * (x[k] - x[k - 1]), -limit, limit)
        out[k] = force.sum()
    return out


def profile(n: int = 4000) -> tuple[Array, Array]:
    t = np.arange(n) * 4e-3
    x = sum(a * np.sin(2 * np.pi * f * t + p) for a, f, p in ((1.0, 0.7, 0), (0.6, 1.9, 1), (0.4, 3.1, 2)))
    return t, np.asarray(x) * (0.6 + 0.4 * np.sin(2 * np.pi * 0.11 * t))


@pytest.mark.parametrize(
    "shape", [lambda x: bouc_wen(x, 1.0), lambda x: bouc_wen(x, 1.7), maxwell_slip], ids=["bw1", "bw1.7", "maxwell"]
)
def test_hysteresis_explains_foreign_loops(shape: Callable[[Array], Array]) -> None:
    t, x = profile()
    y = 2.0 * x + 0.4 - 0.5 * shape(x)
    assert left_over("hysteresis", t, x, y) < 0.03 * loop_height(x, y)


def test_few_plays_between_the_thresholds_are_resolved() -> None:
    """The coarse thresholds leave 0.46 % of the loop's height, and with weights of one sign more."""
    t, x = profile()
    plays = x[:, None] - stops(x, np.array([0.15, 0.45, 0.9]), float(x[0]), ONE)
    y = 2.0 * x + 0.4 + plays @ np.array([0.3, 0.25, 0.2])
    assert left_over("hysteresis", t, x, y) < 0.0035 * loop_height(x, y)


def step_response(kernel: Array, x: Array) -> Array:
    """Superposition of the response ``kernel`` to every change of x from rest at zero."""
    n = x.size
    size = 1 << int(np.ceil(np.log2(2 * n)))
    dx = np.diff(x, prepend=0.0)
    return np.fft.irfft(np.fft.rfft(dx, size) * np.fft.rfft(kernel, size), size)[:n]


@pytest.mark.parametrize("form", ["log", "power", "voigt"])
def test_creep_explains_foreign_relaxation(form: str) -> None:
    rng = np.random.default_rng(3)
    t = np.arange(12000) * 5e-3
    x = np.repeat(rng.uniform(10, 90, 15), 800)
    kernel = {
        "log": 0.02 * np.log10(1 + t / 0.1),
        "power": 0.02 * (t / 10) ** 0.15,
        "voigt": 0.01 * (1 - np.exp(-t / 0.9)) + 0.015 * (1 - np.exp(-t / 11.0)),
    }[form]
    y = 0.12 * (x + step_response(kernel, x))
    creep = y - np.polyval(np.polyfit(x, y, 1), x)
    assert left_over("creep", t, x, y) < 0.03 * 2 * float(np.max(np.abs(creep)))


def test_play_closed_form() -> None:
    x = np.array([0.0, 1.0, 3.0, 2.5, 1.0, -2.0, -1.0, 2.0])
    # by hand, r = 1, from rest at 0: the play follows at distance 1
    play = np.array([0.0, 0.0, 2.0, 2.0, 2.0, -1.0, -1.0, 1.0])
    np.testing.assert_allclose(x - stops(x, np.array([1.0]), 0.0, ONE)[:, 0], play)


def test_wiping_out() -> None:
    """A smaller loop inside a larger one leaves no trace (Mayergoyz): same extremes, same future."""
    radii = np.array([0.1, 0.4, 1.1])
    plain = np.array([0.0, 3.0, -2.0, 2.0])
    detour = np.array([0.0, 3.0, 1.0, 2.5, 0.5, 3.0, -2.0, 2.0])
    np.testing.assert_allclose(stops(plain, radii, 0.0, ONE)[-1], stops(detour, radii, 0.0, ONE)[-1])
    np.testing.assert_allclose(relays(plain, -3, 4, 6, ONE)[-1], relays(detour, -3, 4, 6, ONE)[-1])


def test_memory_does_not_know_speed() -> None:
    t = np.linspace(0, 1, 2001)
    x = np.sin(2 * np.pi * 2 * t)
    slow = np.repeat(x, 3)
    for columns in (
        lambda v: stops(v, np.array([0.2, 0.6]), 0.0, ONE),
        lambda v: dahl(v, np.array([0.3]), np.array([0.4]), 0.0, ONE),
    ):
        np.testing.assert_allclose(columns(x), columns(slow)[2::3], atol=1e-12)


def test_dahl_against_small_steps() -> None:
    """Exact exponentials against Euler steps of dz = dx - (|dx| z + g dx |z|)/r."""
    x = np.array([0.0, 0.7, -0.9, 0.2, 0.15, 1.4])
    r, g = 0.5, 0.4
    z, out = 0.0, [0.0]
    for a, b in pairwise(x):
        d = (b - a) / 20000
        for _ in range(20000):
            z += d - (abs(d) * z + g * d * abs(z)) / r
        out.append(z)
    np.testing.assert_allclose(dahl(x, np.array([r]), np.array([g]), 0.0, ONE)[:, 0], out, atol=2e-4)


def test_memory_is_cleared_at_starts() -> None:
    x = np.sin(np.linspace(0, 12, 400))
    both = stops(x, np.array([0.3]), 0.0, np.array([0, 200]))
    np.testing.assert_array_equal(both[200:], stops(x[200:], np.array([0.3]), 0.0, ONE))


@pytest.mark.parametrize(
    ("kernel", "args"),
    [
        (stops, (np.array([0.1, 0.5]), 0.2, np.array([0, 50]))),
        (dahl, (np.array([0.2, 1.0]), np.array([0.5, -0.3]), 0.1, np.array([0, 50]))),
        (relays, (-1.5, 1.5, 4, np.array([0, 50]))),
    ],
    ids=["stops", "dahl", "relays"],
)
def test_compiled_equals_python(kernel: Callable[..., Array], args: tuple[object, ...]) -> None:
    x = np.cumsum(np.random.default_rng(0).standard_normal(120)) * 0.2
    np.testing.assert_allclose(kernel(x, *args), kernel.py_func(x, *args), atol=1e-13)  # pyright: ignore


def test_short_and_long_steps_of_smooth_elements_are_one_formula() -> None:
    y = np.concatenate([np.geomspace(1e-9, 0.03, 200), np.linspace(0.03, 5.0, 50)])
    assert [risen(v) for v in y] == pytest.approx(-np.expm1(-y), rel=1e-14)


@pytest.mark.parametrize("first", [-1.0, 0.0, 0.4])
def test_a_gap_begins_where_it_was_left(first: float) -> None:
    """The play is moved by the contact that comes first; until then the signal moves alone."""
    x = np.concatenate([np.linspace(2.0, 3.0, 101), np.linspace(3.0, -1.0, 401)])
    effect = EFFECTS["backlash"]
    assert effect.basis is not None
    t = 0.01 * np.arange(x.size)
    gone = -effect.basis(x, context(t, x, x), np.array([0.3, first]), {"span": (4.0,)})[:, 0]
    still = x < 2.0 + 0.3 * (1.0 - first)
    up = still & (t <= 1.0)
    np.testing.assert_allclose(gone[up], x[up] - 2.0 + 0.3 * first, atol=1e-12)
    np.testing.assert_allclose(gone[(t <= 1.0) & ~still], 0.3, atol=1e-12)
    np.testing.assert_allclose(gone[-1], -0.3, atol=1e-12)


@pytest.mark.parametrize(("name", "figures"), [("backlash", (0.3, 0.2)), ("dead_zone", (0.3, 0.1))])
def test_a_form_that_loses_the_whole_slope_is_the_general_one_with_a_share_of_one(
    name: str, figures: tuple[float, ...]
) -> None:
    t = np.arange(900) * 0.01
    x = np.sin(2 * t) * (1 + np.sin(0.7 * t))
    partial = EFFECTS[name]
    (whole,) = partial.variants
    q, ctx = np.array(figures), context(t, x, x)
    assert partial.basis is not None
    assert whole.apply is not None
    settings = partial.prepare(x, x, ctx)
    np.testing.assert_allclose(whole.apply(x, ctx, q, settings), x + partial.basis(x, ctx, q, settings)[:, 0])
    assert [p.name for p in whole.parts(settings).weights] == []
    assert partial.report is not None
    assert whole.report is not None
    general = {h.name: h.value for h in partial.report(np.r_[q, 2.0], settings, 2.0)}
    assert general.pop("slope_lost_inside") == 1.0
    assert {h.name: h.value for h in whole.report(q, settings, 2.0)} == general
