"""Infers the hold of inputs (held or linear between samples) if the recording does not declare it.

To first order the two differ by half a sample of delay, so a twin with the wrong one lacks a "dead time" that no
machine has. The whitened residual is regressed on the difference of both simulations beside the sensitivities to base
parameters (Frisch and Waugh, Econometrica 1, 1933): a share of 0 is linear, of 1 held.
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
"""Largest distance of the share from 0 or 1 at which it decides for that value."""
CLEAR = 6.0
"""Least distance of the share from the rejected value, in standard errors."""


def declared_hold(recording: Recording) -> str:
    """Return the hold that the recording declares: "zero", "linear", or "" if none is declared or needed."""
    p = recording.twin.parameters
    return str(p["hold"]) if "hold" in p else ""


def holdable(problem: Problem) -> bool:
    """Return True if the twin's output depends on the hold of its inputs."""
    return getattr(problem.twin, "hold", "") == "linear" and not declared_hold(problem.recording)


def with_hold(recording: Recording, kind: str) -> Recording:
    """Return the same recording with inputs of this hold."""
    return replace(recording, twin=replace(recording.twin, parameters={**recording.twin.parameters, "hold": kind}))


def as_held(problem: Problem, kind: str = "zero") -> Problem:
    """Return the same problem with inputs of this hold."""
    recording = with_hold(problem.recording, kind)
    twin = make(recording)
    if hasattr(twin, "restart") and twin.restart != problem.twin.restart:
        twin = replace(twin, restart=problem.twin.restart)  # type: ignore[type-var]
    return replace(problem, recording=recording, twin=twin)


def infer_hold(problem: Problem, base: Fit) -> Hold:
    """Return the hold that the data show. ``base``: the twin with its parameters re-fitted, inputs linear.

    A fit with the wrong hold biases the parameters. If the share is nearer to held, it is estimated once more from
    parameters that were fitted with held inputs, and that estimate counts.
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
    """Return a smooth hold if the data support its full difference to a linear one; else None.

    A twin that cannot have it raises RecordingError, and is not changed.
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
    """Estimate the share of the difference between held and linear inputs in the residual of ``fitted``.

    Returns the share and its standard error; (nan, inf) if there is no difference. ``fitted`` belongs to ``problem``.
    """
    with np.errstate(all="ignore"):
        held = Model(zero.twin).simulate(zero.view, fitted.theta)
        straight = Model(linear.twin).simulate(linear.view, fitted.theta)
    rows, spans = problem.fit_rows, problem.fit_spans
    slopes = jacobian(problem, fitted)
    residual: list[np.ndarray] = []
    columns: list[np.ndarray] = []
    for k, o in enumerate(problem.twin.outputs):
        filters = fit_whitener(fitted.residual[o], stretches=spans)
        usable = [s for s in spans if s[1] - s[0] > filters.warm_up + 4]
        change = held[o] - straight[o]
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
    """Return the least-squares coefficient of the first column of ``x`` (n, k) and its standard error."""
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
    """Return True if the model has a delay of half a sample and held inputs explain the held-out part as well."""
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
