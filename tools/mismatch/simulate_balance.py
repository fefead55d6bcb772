"""Starts a force from the balance of the equation of motion along the recording, without a run.

A free run that lacks a force drifts away from the recording, and its residual then shows the force at wrong positions.
Both sides of the balance are weighed by a smooth bump instead, whose derivatives replace those of noisy readings (M.
Shinbrot, Trans. ASME 79 (1957) 447; H. A. Preisig, D. W. T. Rippin, Computers Chem. Engng 17 (1993) 1). The balance is
linear in the weights of the force, and the twin's own parameters move with them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import minimum_filter1d
from scipy.signal import fftconvolve

from sim_devices.physics.effect import Array, Context
from sim_devices.physics.statistics import least_squares, thin
from tools.mismatch.placed import Free, Placed
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_view import View, view_run
from tools.mismatch.twins.base import Balance
from tools.mismatch.twins.dynamic import DynamicTwin
from tools.mismatch.twins.ode import OdeTwin

NARROWEST, WIDEST = 3, 0.02
"""Least half width of a bump in samples, and its largest, as a share of the record."""
CALM = 0.1
"""Largest noise of the weighed derivative, as a share of its rms."""
LEAST_ROWS = 50
"""Least number of samples at which the balance is weighed."""
MOST_MOVED = 0.7
"""Largest move of a base parameter before a search begins, as a share of its value."""
ROWS = 20_000
"""Most samples of a regression."""
GUESSES = 2
"""Number of guesses of an effect that are balanced."""
ROUNDS = 3
"""Number of least squares, each at the parameters of the one before: a mass divides."""


def bump(half: int) -> Array:
    """Return the weights (2 half + 1,) of a bump that is zero, with three derivatives, beyond its ends; their sum is
    one."""
    s = np.arange(-half, half + 1) / (half + 1)
    b = (1.0 - s * s) ** 4
    return b / np.sum(b)


def noise_of(x: Array) -> float:
    """Return the rms noise of readings (n,) by their third differences, which a smooth course leaves small."""
    return 1.4826 * float(np.median(np.abs(np.diff(x, 3)))) / np.sqrt(20.0)


def weighing(balance: Balance, dt: float, noise: float) -> Array | None:
    """Return the narrowest bump under which the derivative as recorded is calm; None if there is none."""
    half = float(NARROWEST)
    while half <= WIDEST * balance.rate.size:
        weights = bump(round(half))
        spread = (
            noise * float(np.linalg.norm(np.diff(np.pad(weights, balance.order), balance.order))) / dt**balance.order
        )
        if spread < CALM * float(np.std(fftconvolve(balance.rate, weights, "valid"))):
            return weights
        half *= np.sqrt(2.0)
    return None


def balanced(model: Model, k: int, view: View, theta: Array, x: Array, ctx: Context) -> list[Array]:
    """Return theta with the force ``k`` of a model and the base parameters from the balance, at the force's guesses.

    ``x`` (n,) and ``ctx``: the course on which the force depends. Empty where not every state was recorded.
    """
    pl, twin = model.placed[k], model.twin
    if not isinstance(twin, DynamicTwin | OdeTwin) or pl.effect.basis is None:
        return []
    run = view_run(twin, view)
    first = twin.balance(run, theta[: model.n_base], pl.target)
    weights = None if first is None else weighing(first, run.dt, noise_of(first.reading))
    if first is None or weights is None:
        return []
    whole = minimum_filter1d(view.mask.astype(np.int8), weights.size + 2, mode="constant") > 0
    for cut in view.recording.segments:
        whole[max(cut - weights.size, 0) : cut + weights.size] = False
    if np.count_nonzero(whole) < LEAST_ROWS:
        return []

    def weighed(y: Array) -> Array:
        return np.asarray(fftconvolve(y, weights, "same"), np.float64)

    others = np.zeros(x.size)
    for p in model.placed:
        if p is not pl and p.site == "feedback" and p.target == pl.target:
            others += _force(model, p, theta, x, ctx)

    def sides(balance: Balance) -> tuple[Array, Array]:
        slopes = np.stack([weighed(c) for c in balance.slopes.T], axis=1)
        return weighed(balance.rate - balance.model - others), slopes

    missing, slopes = sides(first)
    seen = replace(ctx, through=weighed, bends=slopes, mask=whole, noise=None, everywhere=missing)
    rows = thin(whole, ROWS)
    out: list[Array] = []
    for q in pl.effect.guess(x, missing, seen, pl.settings)[:GUESSES]:
        columns = pl.effect.basis(x, seen, np.asarray(q, np.float64), pl.settings)
        if not columns.shape[1] or not np.all(np.isfinite(columns)):
            continue
        columns = np.stack([weighed(c) for c in columns.T], axis=1)
        at = theta.copy()
        own, _ = model.slices(k)
        at[own] = q
        balance: Balance | None = first
        for r in range(ROUNDS):
            # at numbers where the equations diverge, no state is known
            balance = balance if r == 0 else twin.balance(run, at[: model.n_base], pl.target)
            if balance is None:
                break
            missing, slopes = sides(balance)
            if not (np.all(np.isfinite(missing)) and np.all(np.isfinite(slopes))):
                break
            found, _ = least_squares(np.column_stack([columns, slopes])[rows], missing[rows], 1e-9)
            at = _moved(model, k, at, found)
        else:
            out.append(at)
    return [at for at in out if np.all(np.isfinite(at))]


def _force(model: Model, placed: Placed, theta: Array, x: Array, ctx: Context) -> Array:
    """Return the force (n,) of another placed effect along the recorded course."""
    assert placed.effect.basis is not None
    q, w = (theta[part] for part in model.slices(model.placed.index(placed)))
    return placed.effect.basis(x, ctx, q, placed.settings) @ w


def _moved(model: Model, k: int, theta: Array, found: Array) -> Array:
    """Return theta with the weights of force ``k`` and the shifts of the base parameters that were ``found``."""
    out = theta.copy()
    _, weights = model.slices(k)
    size = weights.stop - weights.start
    out[weights] = found[:size]
    for i, shift in enumerate(found[size:].tolist()):
        out[i] = shifted(model.parameters[i], theta[i], shift)
    return out


def shifted(p: Free, value: float, shift: float) -> float:
    """Return a base parameter after a ``shift`` before a search, within ``MOST_MOVED`` and its bounds."""
    most = MOST_MOVED * abs(value) if value else np.inf
    return float(min(max(value + min(max(shift, -most), most), p.lo), p.hi))
