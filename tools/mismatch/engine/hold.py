"""Whether an input was held between its samples or ran linearly, where the recording does not say.

To first order the two differ by half a sample of delay, so a twin that runs the wrong one lacks a "dead time" that no
machine has. The difference of both simulations is regressed on the whitened residual beside everything that the base
parameters can do (Frisch and Waugh, Econometrica 1, 1933): a share of 0 is linear, of 1 held.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tools.errors import RecordingError
from tools.mismatch.engine.colour import fit_whitener, whiten
from tools.mismatch.engine.fit import Fit, fit, fit_base
from tools.mismatch.engine.found import human_values
from tools.mismatch.engine.intervals import jacobian, uncertainty
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.report import Hold
from tools.mismatch.engine.score import misfits
from tools.mismatch.recording import Recording
from tools.mismatch.simulate import Model
from tools.mismatch.twins.make import make

NEAR = 0.3
"""Distance of the share from 0 or 1 within which it says which of the two it is."""
CLEAR = 6.0
"""Standard errors between the share and the other of the two."""


def said_hold(recording: Recording) -> str:
    """The hold that the recording declares: "zero", "linear", or "" where it says nothing or it does not matter."""
    p = recording.twin.parameters
    return str(p["hold"]) if "hold" in p else ""


def holdable(problem: Problem) -> bool:
    """Return whether the twin's answer depends on what its inputs do between the samples."""
    return getattr(problem.twin, "hold", "") == "linear" and not said_hold(problem.recording)


def with_hold(recording: Recording, kind: str) -> Recording:
    """The same recording with inputs that do this between the samples."""
    return replace(recording, twin=replace(recording.twin, parameters={**recording.twin.parameters, "hold": kind}))


def as_held(problem: Problem, kind: str = "zero") -> Problem:
    """The same problem with inputs that do this between the samples."""
    recording = with_hold(problem.recording, kind)
    twin = make(recording)
    if hasattr(twin, "restart") and twin.restart != problem.twin.restart:
        twin = replace(twin, restart=problem.twin.restart)  # type: ignore[type-var]
    return replace(problem, recording=recording, twin=twin)


def infer_hold(problem: Problem, base: Fit) -> Hold:
    """Return which hold the data show. ``base``: the twin with its parameters re-fitted, inputs linear.

    Parameters that were fitted with the wrong hold have bent to it. Where the share lies nearer to held, it is
    estimated once more from parameters that were fitted with held inputs, and that estimate counts.
    """
    other = as_held(problem)
    share, spread = _share(problem, base, problem, other)
    if share > 0.5 and share > CLEAR * spread:
        again = fit_base(other)
        beyond, spread = _share(other, again, problem, other)
        share = 1.0 + beyond
    if not np.isfinite(share) or not np.isfinite(spread):
        return Hold("linear", "assumed")
    if abs(share) < abs(share - 1.0):
        smooth = _smooth(problem, base)
        if smooth is not None:
            return smooth
    ci = (share - 1.96 * spread, share + 1.96 * spread)
    if abs(share - 1.0) < NEAR and share > CLEAR * spread:
        return Hold("zero", "inferred", share, ci)
    if abs(share) < NEAR and 1.0 - share > CLEAR * spread:
        return Hold("linear", "inferred", share, ci)
    return Hold("linear", "assumed", share, ci)


def _smooth(problem: Problem, base: Fit) -> Hold | None:
    """Smooth inputs, where the data ask for all of the difference that they make to straight ones; else None.

    A twin that cannot have them says so with its RecordingError, and is left as it is.
    """
    try:
        other = as_held(problem, "smooth")
    except RecordingError:
        return None
    share, spread = _share(problem, base, problem, other)
    if not (np.isfinite(share) and np.isfinite(spread)) or not (abs(share - 1.0) < NEAR and share > CLEAR * spread):
        return None
    return Hold("smooth", "inferred", share, (share - 1.96 * spread, share + 1.96 * spread))


def _share(problem: Problem, fitted: Fit, linear: Problem, zero: Problem) -> tuple[float, float]:
    """How much of the difference between held and linear inputs the residual of ``fitted`` (of ``problem``) asks for,
    and its standard error; (nan, inf) when nothing differs.
    """
    with np.errstate(all="ignore"):
        there = Model(zero.twin).simulate(zero.view, fitted.theta)
        here = Model(linear.twin).simulate(linear.view, fitted.theta)
    rows, spans = problem.fit_rows, problem.fit_spans
    slopes = jacobian(problem, fitted)
    residual: list[np.ndarray] = []
    columns: list[np.ndarray] = []
    for k, o in enumerate(problem.twin.outputs):
        filters = fit_whitener(fitted.residual[o], stretches=spans)
        usable = [s for s in spans if s[1] - s[0] > filters.warm_up + 4]
        change = there[o] - here[o]
        if not usable or not np.all(np.isfinite(change)) or not np.any(change):
            continue
        scale = 1.0 / problem.sigma(o)
        full = np.zeros((problem.index.size, slopes.shape[1]))
        full[rows] = slopes[k * rows.size : (k + 1) * rows.size]
        both = [change * scale, *full.T]
        columns.append(np.column_stack([whiten(filters, np.ascontiguousarray(c), usable) for c in both]))
        residual.append(whiten(filters, fitted.residual[o] * scale, usable))
    if not columns:
        return np.nan, np.inf
    x, e = np.concatenate(columns), np.concatenate(residual)
    size = np.maximum(np.linalg.norm(x, axis=0), 1e-300)
    share, spread = _first_coefficient(x / size, e)
    return share / size[0], spread / size[0]


def _first_coefficient(x: np.ndarray, e: np.ndarray) -> tuple[float, float]:
    """Least-squares coefficient of the first column of ``x`` (n, k) beside the others, and its standard error."""
    first, others = x[:, 0], x[:, 1:]
    own = first - others @ np.linalg.lstsq(others, first, rcond=1e-10)[0] if others.shape[1] else first
    rest = e - others @ np.linalg.lstsq(others, e, rcond=1e-10)[0] if others.shape[1] else e
    power = float(own @ own)
    if power <= 1e-12 * float(first @ first):
        return 0.0, np.inf
    share = float(own @ rest) / power
    left = rest - share * own
    return share, float(np.sqrt(float(left @ left) / max(left.size - x.shape[1], 1) / power))


DELAYS = ("dead_time", "channel_delay")
NO_WORSE = 1.02


def delay_is_hold(problem: Problem, fitted: Fit) -> bool:
    """Whether the model has a delay of half a sample in whose place held inputs explain the held-out part as well."""
    half = 0.5 * problem.recording.dt
    values = human_values(problem, fitted, uncertainty(problem, fitted))
    for k, placed in enumerate(fitted.model.placed):
        delay = values.get(placed.label, {}).get("delay_s") if placed.effect.name in DELAYS else None
        if delay is None or not abs(delay.value - half) < max(delay.ci95[1] - delay.value, 0.2 * half):
            continue
        other = as_held(problem)
        rest = [p for j, p in enumerate(fitted.model.placed) if j != k]
        model = Model(other.twin, rest)
        theta = model.carry(fitted.model, fitted.theta, other.recording)
        again = fit(other, model, [theta], iterations=25)
        before, after = misfits(problem, fitted), misfits(other, again)
        if again.ok and all(after[o] <= NO_WORSE * before[o] + 0.02 for o in before):
            return True
    return False
