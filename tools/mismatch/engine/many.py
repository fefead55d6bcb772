"""Compares recordings of a system: leave-one-out scores, estimates in each, and the conditions that these follow."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy import stats

from hal.arrays import Array
from tools.mismatch.engine.fit import Fit, fit, moved_a_little
from tools.mismatch.engine.intervals import jacobian
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.report import BetweenRecordings, Change, HeldOutRecording, Together
from tools.mismatch.engine.residual import residuals
from tools.mismatch.engine.split import Split, cut, leave_out
from tools.mismatch.engine.workers import mapped
from tools.mismatch.recording import Condition, Part, Recording
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_view import View

MOST_FOLDS = 20
"""Largest number of folds of the held-out score. More recordings are left out in groups, so that the computing time
grows with their length only."""
LEVEL = 0.005
"""Corrected p-value below which a change between recordings is named: a false one in 200 families."""
LEAST_RECORDINGS = 4
"""Least number of recordings for which changes between them are reported."""
ORDER = "order"
"""Name of the condition that every family has: the place of a recording in the command."""
SAME_INPUT = 1e-3
"""Largest difference of two inputs, as a share of the range, that still counts as a repeat."""


def repeated_noise(recording: Recording, output: str) -> float | None:
    """Estimate the noise rms of an output from pairs of recordings with the same inputs; None without such pairs.

    It is half the variance of the difference of two such recordings. An offset and a scale between the two are removed,
    because they may change between recordings; the first tenth is left out, because start states may differ.
    """
    found: list[float] = []
    # pairs of neighbours are enough and keep the number of pairs linear
    for a, b in itertools.pairwise(recording.parts):
        n = b.stop - b.start
        if a.stop - a.start != n or not all(
            _alike(x[a.start : a.stop], x[b.start : b.stop]) for x in recording.inputs.values()
        ):
            continue
        y, z = (recording.outputs[output][p.start + n // 10 : p.stop] for p in (a, b))
        design = np.column_stack([np.ones(y.size), y])
        weights = np.linalg.lstsq(design, z, rcond=None)[0]
        found.append(float(np.mean((z - design @ weights) ** 2)) / (1.0 + float(weights[1]) ** 2))
    return float(np.sqrt(np.mean(found))) if found and max(found) > 0 else None


def _alike(x: Array, y: Array) -> bool:
    return float(np.max(np.abs(x - y))) <= SAME_INPUT * float(np.ptp(x))


def free_names(model: Model) -> dict[str, int]:
    """Return the index of each parameter by the names for ``--per-recording``: ``gain`` and ``gain_um_per_V``."""
    out: dict[str, int] = {}
    for i, p in enumerate(model.parameters):
        if p.placed >= 0:
            effect = model.placed[p.placed].effect.name
            out.setdefault(f"{effect}.{p.name.rsplit('.', 1)[-1]}", i)
        else:
            out.setdefault(p.name, i)
            out.setdefault(p.name.split("_")[0], i)
    return out


def freed(model: Model, names: Sequence[str]) -> tuple[int, ...]:
    """Return indices of the parameters that are free in each recording; the name of an effect frees all of its own."""
    known = free_names(model)
    found = {i for n in names for k, i in known.items() if k == n or k.startswith(n + ".")}
    return tuple(sorted(found))


def everything(problem: Problem) -> Problem:
    """Return the same problem with all recordings fitted and none held out."""
    spans = tuple(sorted({*problem.split.fit, *((a - problem.init, b) for a, b in problem.split.held_out)}))
    return replace(problem, split=Split(problem.recording.n, spans, (), (), cut(spans, 48), own=False))


def levelled(problem: Problem, base: Fit) -> Recording:
    """Remove the contribution of free base parameters in each part from the outputs of a recording.

    The search for effects then uses one value for all parts. Parameters of effects are not affected.
    """
    rec, whole = problem.recording, everything(problem)
    names = freed(base.model, rec.per_recording)
    if not names:
        return rec
    deltas, _ = part_estimates(whole, replace(base, residual=residuals(whole, base.model, base.theta)), names)
    outputs = {o: x.copy() for o, x in rec.outputs.items()}
    deltas = deltas - deltas.mean(axis=0)
    for part, delta in zip(rec.parts, deltas, strict=True):
        alone = _alone(rec, part)
        view = View(alone, ((0, alone.n),), problem.init, fit=((0, alone.n),) if problem.settle else ())
        before, after = (base.model.simulate(view, theta) for theta in (base.theta, base.theta + delta))
        for o, y in outputs.items():
            y[part.start : part.stop] -= after[o] - before[o]
    return replace(rec, outputs=outputs, levels=tuple(tuple(map(float, d)) for d in deltas))


def _alone(recording: Recording, part: Part) -> Recording:
    inside = slice(part.start, part.stop)
    signals = {
        kind: {s: x[inside] for s, x in getattr(recording, kind).items()} for kind in ("inputs", "outputs", "context")
    }
    t = recording.t[inside] - recording.t[part.start]
    return replace(recording, t=t, segments=recording.segments_of(part.start, part.stop), parts=(), **signals)


def part_estimates(problem: Problem, fitted: Fit, which: Sequence[int]) -> tuple[Array, Array]:
    """Estimate the deviations of the parameters ``which`` of each recording from the shared ones, to first order.

    Returns the deviations (one Gauss-Newton step) and their standard errors, widened by the colour of the residual,
    (parts, parameters) each.
    """
    columns = jacobian(problem, fitted)[:, list(which)]
    rows = problem.fit_rows
    outputs = problem.twin.outputs
    left = np.concatenate([fitted.residual[o][rows] / problem.sigma(o) for o in outputs])
    sample = problem.index[rows]
    delta = np.zeros((len(problem.recording.parts), fitted.theta.size))
    error = np.zeros_like(delta)
    for i, part in enumerate(problem.recording.parts):
        one, other = np.searchsorted(sample, (part.start, part.stop))
        inside = np.concatenate([np.arange(one, other) + k * rows.size for k in range(len(outputs))])
        a, r = columns[inside], left[inside]
        size = np.linalg.norm(a, axis=0)
        seen = np.flatnonzero(size > 0)
        if r.size <= seen.size + 2:
            continue
        u, s, vt = np.linalg.svd(a[:, seen] / size[seen], full_matrices=False)
        keep = s > 1e-4 * s[0]
        step = vt[keep].T @ ((u[:, keep].T @ r) / s[keep]) / size[seen]
        rest = r - a[:, seen] @ step
        rho = float(np.clip(rest[1:] @ rest[:-1] / max(rest @ rest, 1e-300), 0.0, 0.999))
        variance = float(rest @ rest) / (r.size - seen.size) * (1 + rho) / (1 - rho)
        spread = np.sqrt(variance * np.sum((vt[keep].T / s[keep]) ** 2, axis=1)) / size[seen]
        at = np.array(which)[seen]
        delta[i, at], error[i, at] = step, spread
    return delta, error


def fold(
    problem: Problem, base: Fit, fitted: Fit, out: tuple[int, ...]
) -> tuple[tuple[int, ...], dict[str, Array], dict[str, Array]]:
    """Fit both models without the recordings ``out`` and return what they leave there, (samples,) per output."""
    rec = problem.recording
    spans = everything(problem).split.fit
    left_out = leave_out(rec.n, spans, out, init=problem.init)
    without = replace(problem, split=left_out)
    found: list[dict[str, Array]] = []
    for known in (base, fitted):
        again = fit(without, known.model, [known.theta], iterations=10)
        residual = again.residual if again.ok else residuals(without, known.model, known.theta)
        found.append({o: r[without.held_rows] for o, r in residual.items()})
    return out, found[0], found[1]


def compare_recordings(problem: Problem, base: Fit, fitted: Fit, jobs: int = 1) -> Together:
    """Score the model on each left-out recording, estimate its parameters in each, and test what they follow."""
    parts = problem.recording.parts
    groups = [tuple(int(i) for i in g) for g in np.array_split(np.arange(len(parts)), min(len(parts), MOST_FOLDS))]
    folds = mapped(problem, fold, [(problem, base, fitted, g) for g in groups], jobs)
    rms = lambda r: float(np.sqrt(np.mean(r**2)))  # noqa: E731
    outputs = problem.twin.outputs
    held = tuple(
        HeldOutRecording(
            tuple(parts[i].name for i in out), {o: rms(a[o]) for o in outputs}, {o: rms(b[o]) for o in outputs}
        )
        for out, a, b in folds
    )
    total = [{o: rms(np.concatenate([f[k][o] for f in folds])) for o in outputs} for k in (1, 2)]
    p_value = None
    if fitted.model.placed and len(held) > 1:
        gain = [sum(np.log(h.recalibrated_rms[o] / max(h.fitted_rms[o], 1e-300)) for o in outputs) for h in held]
        p_value = _one_sided(np.array(gain)) if np.ptp(gain) > 0 else 1.0
    whole = everything(problem)
    model = fitted.model
    free = freed(model, problem.recording.per_recording)
    which = sorted({*range(model.n_base), *free})
    again = replace(fitted, residual=residuals(whole, model, fitted.theta))
    deltas, errors = part_estimates(whole, again, which)
    if problem.recording.levels:
        deltas[:, : model.n_base] += np.array(problem.recording.levels)
    parameters = in_words(problem.recording, model, fitted.theta, deltas, errors, free)
    conditions = conditions_of(problem.recording)
    changes, tried = changes_between(parameters, conditions)
    return Together(
        tuple(p.name for p in parts), held, total[0], total[1], p_value, parameters, conditions, changes, tried
    )


def _one_sided(gain: Array) -> float:
    """Return the p-value of Student's t-test that the mean of ``gain`` (folds,) is not above zero."""
    t = float(np.mean(gain)) / (float(np.std(gain, ddof=1)) / np.sqrt(gain.size))
    return float(stats.t.sf(t, gain.size - 1))


def in_words(
    recording: Recording, model: Model, theta: Array, deltas: Array, errors: Array, free: Sequence[int]
) -> tuple[BetweenRecordings, ...]:
    """Return estimates of the human parameters from deviations (parts, parameters) of the searched ones."""

    def values(at: Array) -> dict[tuple[str, str], tuple[float, str]]:
        return {(g, h.name): (float(h.value), h.unit) for g, found in model.human(at).items() for h in found}

    here = values(theta)
    # a human parameter is free if a free searched one moves it
    loose = {
        k
        for i in free
        for k, v in values(moved_a_little(model, theta, i)).items()
        if (k[0] == "base") == (model.parameters[i].placed < 0) and v[0] != here[k][0]
    }
    each = [values(theta + d) for d in deltas]
    spread = [
        {
            k: np.sqrt(
                sum((values(theta + d + _only(e, i))[k][0] - now[k][0]) ** 2 for i in map(int, np.flatnonzero(e)))
            )
            for k in here
        }
        for d, e, now in zip(deltas, errors, each, strict=True)
    ]
    out: list[BetweenRecordings] = []
    for (group, name), (_, unit) in here.items():
        found = np.array([v[(group, name)][0] for v in each])
        if group != "base" and (group, name) not in loose:
            continue  # only the base moves it
        if np.all(np.isfinite(found)) and np.ptp(found) > 1e-9 * np.max(np.abs(found)):
            label = name if group == "base" else f"{group}.{name}"
            se = tuple(float(s[(group, name)]) for s in spread)
            out.append(BetweenRecordings(label, unit, (group, name) in loose, tuple(map(float, found)), se))
    return tuple(out)


def _only(x: Array, i: int) -> Array:
    out = np.zeros_like(x)
    out[i] = x[i]
    return out


def conditions_of(recording: Recording) -> dict[str, tuple[Condition, ...]]:
    """Return the conditions that every recording states in the same form, means of context channels, and the order."""
    parts = recording.parts
    out: dict[str, tuple[Condition, ...]] = {ORDER: tuple(float(i + 1) for i in range(len(parts)))}
    for name in dict.fromkeys(k for p in parts for k in p.conditions):
        values = [p.conditions.get(name) for p in parts]
        if len({type(v) for v in values}) == 1 and len(set(values)) > 1:
            out[name] = tuple(v for v in values if v is not None)
    for name, x in recording.context.items():
        means = tuple(float(np.mean(x[p.start : p.stop])) for p in parts)
        if np.ptp(means) > 0:
            out[f"mean {name}"] = means
    return out


def changes_between(
    parameters: Sequence[BetweenRecordings], conditions: Mapping[str, tuple[Condition, ...]]
) -> tuple[tuple[Change, ...], int]:
    """Return the parameters that follow a condition, and the number of tested pairs (Bonferroni's correction).

    Numbers are tested by the t-test of a straight line, words by the F-test of one mean per word (one-way analysis of
    variance).
    """
    pairs: list[tuple[BetweenRecordings, str, float | None, float]] = []
    for p in parameters:
        for name, values in conditions.items():
            tested = _test(np.array(p.values), values)
            if tested is not None:
                pairs.append((p, name, *tested))
    changes: list[Change] = []
    for p in parameters:
        tests = sorted(((min(1.0, q * len(pairs)), n, s) for x, n, s, q in pairs if x is p), key=lambda m: m[0])
        if not tests or not tests[0][0] < LEVEL:
            continue
        q, name, slope = tests[0]
        mean = abs(float(np.mean(p.values)))
        same = tuple(n for other, n, _ in tests[1:] if other < LEVEL)
        changes.append(Change(p.name, name, slope, None if slope is None or mean == 0 else slope / mean, q, same))
    return tuple(sorted(changes, key=lambda c: c.p_value)), len(pairs)


def _test(values: Array, condition: Sequence[Condition]) -> tuple[float | None, float] | None:
    """Return (slope, p-value) of values (parts,) against a condition, None if there are too few to test."""
    if values.size < LEAST_RECORDINGS:
        return None
    if all(isinstance(c, float) for c in condition):
        x = np.array([float(c) for c in condition])
        if np.unique(x).size < 3:
            return None
        centred = x - x.mean()
        slope = float(centred @ values) / float(centred @ centred)
        left = values - values.mean() - slope * centred
        error = np.sqrt(float(left @ left) / (values.size - 2) / float(centred @ centred))
        return slope, float(2 * stats.t.sf(abs(slope) / max(float(error), 1e-300), values.size - 2))
    groups = [values[[c == w for c in condition]] for w in dict.fromkeys(condition)]
    if len(groups) < 2 or values.size - len(groups) < 2 or max(float(np.ptp(g)) for g in groups) == 0.0:
        return None
    return None, float(stats.f_oneway(*groups).pvalue)
