"""Starts a force from the balance of the equation of motion along the recording, without a run.

A free run that lacks a force drifts away from the recording, and its residual then shows the force at wrong positions.
Both sides of the balance are weighed by a smooth bump instead, whose derivatives replace those of noisy readings (M.
Shinbrot, Trans. ASME 79 (1957) 447; H. A. Preisig, D. W. T. Rippin, Computers Chem. Engng 17 (1993) 1). The balance is
linear in the weights of the force, and the twin's own parameters move with them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d
from scipy.signal import fftconvolve

from sim_devices.physics.effect import Array, Context
from sim_devices.physics.statistics import least_squares, thin
from tools.mismatch.placed import Free
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

    Other forces there are as they are, or move with it: beside a force that was missing they were fitted for two.
    ``x`` (n,) and ``ctx``: the course on which the force depends. Empty where not every state was recorded.
    """
    pl, twin = model.placed[k], model.twin
    if not isinstance(twin, DynamicTwin | OdeTwin) or pl.effect.basis is None:
        return []
    run = model.driven(view_run(twin, view), theta)
    first = twin.balance(run, theta[: model.n_base], pl.target)
    weights = None if first is None else weighing(first, run.dt, noise_of(first.reading))
    if first is None or weights is None:
        return []
    whole = within(view, weights)
    if np.count_nonzero(whole) < LEAST_ROWS:
        return []

    def weighed(y: Array) -> Array:
        return np.asarray(fftconvolve(y, weights, "same"), np.float64)

    beside = [
        j
        for j, p in enumerate(model.placed)
        if j != k and p.site == "feedback" and p.target == pl.target and p.effect.basis is not None
    ]
    forces = {j: force_columns(model, j, theta, x, ctx) for j in beside}
    others = sum((c @ theta[model.slices(j)[1]] for j, c in forces.items()), np.zeros(x.size))
    free = [forces] if forces and all(np.all(np.isfinite(c)) for c in forces.values()) else []

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
        for moving in [*free, dict[int, Array]()]:
            every = {k: columns, **moving}
            design = np.stack([weighed(c) for c in np.column_stack(list(every.values())).T], axis=1)
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
                was = [theta[i] for j in moving for i in _weights(model, j)]
                missing = missing + design[:, columns.shape[1] :] @ was
                if not (np.all(np.isfinite(missing)) and np.all(np.isfinite(slopes))):
                    break
                found, _ = least_squares(np.column_stack([design, slopes])[rows], missing[rows], 1e-9)
                at = _moved(model, list(every), at, found)
            else:
                out.append(at)
    return [at for at in out if np.all(np.isfinite(at))]


def within(view: View, weights: Array) -> NDArray[np.bool_]:
    """Return a mask (n,) of the samples around which the bump lies within the view and within one segment."""
    whole = minimum_filter1d(view.mask.astype(np.int8), weights.size + 2, mode="constant") > 0
    for cut in view.recording.segments:
        whole[max(cut - weights.size, 0) : cut + weights.size] = False
    return whole


def _weights(model: Model, j: int) -> range:
    """Return the places of the weights of placed effect ``j``."""
    own = model.slices(j)[1]
    return range(own.start, own.stop)


def force_columns(model: Model, j: int, theta: Array, x: Array, ctx: Context) -> Array:
    """Return the force per weight (n, k) of another placed effect along the recorded course."""
    placed = model.placed[j]
    assert placed.effect.basis is not None
    return placed.effect.basis(x, ctx, theta[model.slices(j)[0]], placed.settings)


def _moved(model: Model, forces: Sequence[int], theta: Array, found: Array) -> Array:
    """Return theta with the weights of ``forces`` and the shifts of the base parameters that were ``found``."""
    out = theta.copy()
    places = [i for j in forces for i in _weights(model, j)]
    for i, value in zip(places, found.tolist(), strict=False):
        out[i] = min(max(value, model.parameters[i].lo), model.parameters[i].hi)
    for i, shift in enumerate(found[len(places) :].tolist()):
        out[i] = shifted(model.parameters[i], theta[i], shift)
    return out


def shifted(p: Free, value: float, shift: float) -> float:
    """Return a base parameter after a ``shift`` before a search, within ``MOST_MOVED`` and its bounds."""
    most = MOST_MOVED * abs(value) if value else np.inf
    return float(min(max(value + min(max(shift, -most), most), p.lo), p.hi))
