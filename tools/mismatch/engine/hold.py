"""Infers the hold of inputs (held or linear between samples) if the recording does not declare it.

To first order the two differ by half a sample of delay, so a twin with the wrong one lacks a "dead time" that no
machine has. The whitened residual is regressed on the difference of both simulations beside the sensitivities to base
parameters (Frisch and Waugh, Econometrica 1, 1933): a share of 0 is linear, of 1 held.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sim_devices.physics.effect import Array
from tools.errors import RecordingError
from tools.mismatch.engine.colour import fit_whitener, whiten
from tools.mismatch.engine.fit import Fit, fit_base
from tools.mismatch.engine.intervals import jacobian
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.report import Hold, HoldHow, HoldKind
from tools.mismatch.recording import Recording
from tools.mismatch.simulate import Model
from tools.mismatch.twins.dynamic import DynamicTwin
from tools.mismatch.twins.holds import declared_holds
from tools.mismatch.twins.make import make
from tools.mismatch.twins.ode import OdeTwin

NEAR = 0.3
"""Largest distance of the share from 0 or 1 at which it decides for that value."""
CLEAR = 6.0
"""Least distance of the share from the rejected value, in standard errors."""


def undeclared(problem: Problem) -> tuple[str, ...]:
    """Return the inputs whose hold the twin's output depends on and the recording does not declare."""
    holds = getattr(problem.twin, "holds", {})
    stated = declared_holds(problem.recording)
    return tuple(s for s, h in holds.items() if h == "linear" and s not in stated)


def hold_groups(problem: Problem, inputs: Sequence[str]) -> list[tuple[str, ...]]:
    """Return the groups of ``inputs`` that have one hold: each its own, or all that of a program that is told one."""
    return [(s,) for s in inputs] if isinstance(problem.twin, DynamicTwin | OdeTwin) else [tuple(inputs)]


def with_hold(recording: Recording, kinds: Mapping[str, str]) -> Recording:
    """Return the same recording with inputs of these holds."""
    holds = {**declared_holds(recording), **kinds}
    alike = set(holds.values()) if holds.keys() >= recording.inputs.keys() else set[str]()
    hold = alike.pop() if len(alike) == 1 else holds
    return replace(recording, twin=replace(recording.twin, parameters={**recording.twin.parameters, "hold": hold}))


def as_held(problem: Problem, kinds: Mapping[str, str]) -> Problem:
    """Return the same problem with inputs of these holds. Raises RecordingError if the twin cannot have them."""
    recording = with_hold(problem.recording, kinds)
    twin = make(recording)
    if hasattr(twin, "restart") and twin.restart != problem.twin.restart:
        twin = replace(twin, restart=problem.twin.restart)  # type: ignore[type-var]
    return replace(problem, recording=recording, twin=twin)


@dataclass(frozen=True)
class Share:
    """Holds the ``size`` of the difference that another hold makes in the residual, and its standard error."""

    size: float
    spread: float

    @property
    def finite(self) -> bool:
        """Return True if the data have any say."""
        return bool(np.isfinite(self.size) and np.isfinite(self.spread))

    @property
    def is_whole(self) -> bool:
        """Return True if the data support the whole difference and reject none of it."""
        return self.finite and abs(self.size - 1.0) < NEAR and self.size > CLEAR * self.spread

    @property
    def is_nothing(self) -> bool:
        """Return True if the data support none of the difference and reject the whole."""
        return self.finite and abs(self.size) < NEAR and 1.0 - self.size > CLEAR * self.spread

    def as_hold(self, kind: HoldKind, how: HoldHow) -> Hold:
        """Return the finding with this share."""
        return Hold(kind, how, self.size, (self.size - 1.96 * self.spread, self.size + 1.96 * self.spread))


def infer_holds(problem: Problem, base: Fit) -> dict[str, Hold]:
    """Return the hold of each input: as declared, or as the data show. ``base``: the twin re-fitted, inputs linear.

    A fit with the wrong hold biases the parameters. Where a share is nearer to held, all are estimated once more from
    parameters that were fitted with these inputs held, and those estimates count.
    """
    holds = getattr(problem.twin, "holds", {})
    stated = declared_holds(problem.recording)
    found: dict[str, Hold] = {s: Hold(h, "declared") for s, h in holds.items() if s in stated and h != "discrete"}
    free = undeclared(problem)
    if not free:
        return found
    groups = hold_groups(problem, free)
    shares = _shares(problem, base, groups, "zero")
    held = [g for g, x in zip(groups, shares, strict=True) if x.finite and x.size > max(0.5, CLEAR * x.spread)]
    straight, at = problem, base
    if held:
        straight = as_held(problem, {s: "zero" for g in held for s in g})
        at = fit_base(straight)
        shares = _shares(straight, at, groups, "zero")
        shares = [replace(x, size=1.0 + x.size) if g in held else x for g, x in zip(groups, shares, strict=True)]
    near = [g for g, x in zip(groups, shares, strict=True) if x.finite and abs(x.size) < abs(x.size - 1.0)]
    smooth = dict(zip(near, _smooth(straight, at, near), strict=True)) if near else {}
    for g, x in zip(groups, shares, strict=True):
        if g in smooth and smooth[g].is_whole:
            hold = smooth[g].as_hold("smooth", "inferred")
        elif x.is_whole:
            hold = x.as_hold("zero", "inferred")
        else:
            hold = x.as_hold("linear", "inferred" if x.is_nothing else "assumed")
            if not x.finite:
                hold = Hold("linear", "assumed")
        found |= dict.fromkeys(g, hold)
    return {s: found[s] for s in holds if s in found}


def _smooth(problem: Problem, base: Fit, groups: Sequence[tuple[str, ...]]) -> list[Share]:
    """Return the share of smooth inputs for each group; none of it for a twin that cannot have them."""
    try:
        return _shares(problem, base, groups, "smooth")
    except RecordingError:
        return [Share(np.nan, np.inf)] * len(groups)


def _shares(problem: Problem, fitted: Fit, groups: Sequence[tuple[str, ...]], kind: str) -> list[Share]:
    """Estimate the shares in the residual of ``fitted`` of what each group of inputs changes as ``kind``.

    An input that is so already is changed to linear, with the sign turned. A share is nan where there is no difference.
    """
    now = Model(problem.twin).simulate(problem.view, fitted.theta)
    changes: list[Mapping[str, Array]] = []
    with np.errstate(all="ignore"):
        for g in groups:
            turned = problem.twin.holds[g[0]] == kind  # type: ignore[attr-defined]
            other = as_held(problem, dict.fromkeys(g, "linear" if turned else kind))
            then = Model(other.twin).simulate(other.view, fitted.theta)
            changes.append({o: (now[o] - then[o]) if turned else (then[o] - now[o]) for o in now})
    rows, spans = problem.fit_rows, problem.fit_spans
    slopes = jacobian(problem, fitted)
    residual: list[Array] = []
    columns: list[Array] = []
    for k, o in enumerate(problem.twin.outputs):
        filters = fit_whitener(fitted.residual[o], stretches=spans)
        usable = [s for s in spans if s[1] - s[0] > filters.warm_up + 4]
        change = np.stack([c[o] for c in changes])
        if not usable or not np.all(np.isfinite(change)) or not np.any(change):
            continue
        scale = 1.0 / problem.sigma(o)
        full = np.zeros((problem.index.size, slopes.shape[1]))
        full[rows] = slopes[k * rows.size : (k + 1) * rows.size]
        each = [*(scale * change), *full.T]
        columns.append(np.column_stack([whiten(filters, np.ascontiguousarray(c), usable) for c in each]))
        residual.append(whiten(filters, fitted.residual[o] * scale, usable))
    if not columns:
        return [Share(np.nan, np.inf)] * len(groups)
    x, e = np.concatenate(columns), np.concatenate(residual)
    size = np.linalg.norm(x, axis=0)
    x = x / np.maximum(size, 1e-300)
    found: list[Share] = []
    for i in range(len(groups)):
        one, spread = _first_coefficient(np.column_stack([x[:, i], np.delete(x, i, axis=1)]), e)
        found.append(Share(one / size[i], spread / size[i]) if size[i] > 0.0 else Share(np.nan, np.inf))
    return found


def _first_coefficient(x: Array, e: Array) -> tuple[float, float]:
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


DELAYS = frozenset({"dead_time", "channel_delay"})
"""Effects that a wrong hold imitates: to first order it is a delay of half a sample."""
