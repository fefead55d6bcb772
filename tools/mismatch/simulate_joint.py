"""Fits a set of effects and the twin's own parameters to the balance of the equations of motion along a recording.

Beside an effect that was missing, the others and the base were fitted for two, and a free run from there leads nowhere
(a limit of the drive without cogging is found where the largest accelerations are). The balance needs no run: its error
at one sample does not depend on those before, and all parameters move at once.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import fftconvolve

from sim_devices.physics.effect import Array
from sim_devices.physics.statistics import thin
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_balance import LEAST_ROWS, force_columns, noise_of, weighing, within
from tools.mismatch.simulate_start import probe_signals
from tools.mismatch.simulate_view import View, view_run
from tools.mismatch.twins.dynamic import DynamicTwin
from tools.mismatch.twins.ode import OdeTwin

ROWS = 5_000
"""Most samples of an equation of motion at which its balance counts."""
EVALUATIONS = 30
"""Largest number of steps of the search."""
FAR = 1e6
"""Error, in units of that at the start, at numbers where the equations diverge."""

Side = Callable[[Array], Array]


def in_balance(model: Model, view: View, theta: Array) -> Array | None:
    """Return theta with the base and all effects but those at outputs fitted to the balance, from ``theta`` on.

    None where a state was not recorded or is too noisy, and without a force.
    """
    targets = dict.fromkeys(p.target for p in model.placed if p.site == "feedback")
    sides = [_side(model, view, theta, target) for target in targets]
    found = [s for s in sides if s is not None]
    if not found or len(found) < len(sides):
        return None
    free = [*range(model.n_base)]
    for j, placed in enumerate(model.placed):
        if placed.site != "output":
            free += [i for s in model.slices(j) for i in range(s.start, s.stop)]
    parameters = [model.parameters[i] for i in free]
    lo, hi = np.array([p.lo for p in parameters]), np.array([p.hi for p in parameters])
    size = np.array([abs(theta[i]) or abs(p.scale) or 1.0 for i, p in zip(free, parameters, strict=True)])
    scales = [max(float(np.sqrt(np.mean(side(theta) ** 2))), 1e-300) for side in found]

    def errors(values: Array) -> Array:
        at = theta.copy()
        at[free] = values
        e = np.concatenate([side(at) / scale for side, scale in zip(found, scales, strict=True)])
        return np.nan_to_num(e, nan=FAR, posinf=FAR, neginf=-FAR)

    begin = np.clip(theta[free], np.nextafter(lo, np.inf), np.nextafter(hi, -np.inf))
    if not np.all(np.isfinite(begin)) or np.any(lo >= hi):
        return None
    # readings around a turn of dry friction fit no bump
    search = least_squares(
        errors, begin, bounds=(lo, hi), x_scale=size, loss="soft_l1", f_scale=0.1, max_nfev=EVALUATIONS
    )
    out = theta.copy()
    out[free] = search.x
    return out


def _side(model: Model, view: View, theta: Array, target: str) -> Side | None:
    """Return the error of the balance at a place, as a function of theta."""
    twin = model.twin
    if not isinstance(twin, DynamicTwin | OdeTwin):
        return None
    here = [j for j, p in enumerate(model.placed) if p.site == "feedback" and p.target == target]
    if any(model.placed[j].effect.basis is None for j in here):
        return None
    run = view_run(twin, view)
    balance = twin.balance(model.driven(run, theta), theta[: model.n_base], target)
    weights = None if balance is None else weighing(balance, run.dt, noise_of(balance.reading))
    if balance is None or weights is None:
        return None
    whole = within(view, weights)
    if np.count_nonzero(whole) < LEAST_ROWS:
        return None
    rows = thin(whole, ROWS)
    x, ctx = probe_signals(model, view, theta, model.placed[here[0]], model.placed[here[0]].outputs[0])

    def error(theta: Array) -> Array:
        left = balance.rate - balance.at(theta[: model.n_base], model.driven(run, theta).signals)
        for j in here:
            left = left - force_columns(model, j, theta, x, ctx) @ theta[model.slices(j)[1]]
        return np.asarray(fftconvolve(left, weights, "same"), np.float64)[rows]

    return error
