"""Estimates the start of a placed effect: its settings and first parameters, from the residual without it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sim_devices.physics.effect import Array, Context, Settings
from sim_devices.physics.flows import PAIRS, RANGES
from sim_devices.physics.forces import base_moves
from sim_devices.physics.heat_loss import KELVIN, TEMPERATURES
from sim_devices.physics.statistics import least_squares, runs, thin
from tools.mismatch.placed import Placed
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_balance import balanced, shifted
from tools.mismatch.simulate_chain import make_context
from tools.mismatch.simulate_flows import flow_starts
from tools.mismatch.simulate_view import View, view_run
from tools.mismatch.twins.base import Signal, travelled
from tools.mismatch.twins.cascade import BETWEEN, CascadeTwin
from tools.mismatch.twins.feedback import FASTEST
from tools.mismatch.twins.memo import remember
from tools.mismatch.twins.ode import inside_of
from tools.mismatch.twins.ode_inside import PUSHED


def prepare(model: Model, view: View, theta: Array, pl: Placed) -> Placed:
    """Return ``pl`` with its settings read from the residual of ``model`` at ``theta`` on the view.

    An effect of several outputs that has a test of its own reads them off the output that shows it best.
    """
    best: tuple[float, Settings] | None = None
    outputs = pl.outputs if pl.effect.test is not None and not pl.effect.shared else pl.outputs[:1]
    for output in outputs:
        x, ctx = probe_signals(model, view, theta, pl, output)
        residual = full_residual(model, view, theta, output)
        settings = pl.effect.prepare(x, residual, ctx)
        share = pl.effect.test(x, residual, ctx).share if pl.effect.test is not None and len(outputs) > 1 else 0.0
        if best is None or share > best[0]:
            best = (share, settings)
    assert best is not None
    settings, rate = best[1], getattr(model.twin, "fastest_per_s", 0.0)
    if pl.site == "feedback" and rate:
        settings = {**settings, FASTEST: (rate,)}
    return replace(pl, settings=settings)


def starts(model: Model, k: int, view: View, theta: Array) -> list[Array]:
    """Return theta with placed effect ``k`` at each of its guesses, from the residual at ``theta`` without it.

    The other effects keep their parameters.
    """
    pl, twin = model.placed[k], model.twin
    rest = Model(twin, [p for j, p in enumerate(model.placed) if j != k])
    without = rest.carry(model, theta, view.recording)
    output = pl.outputs[0]
    residual = full_residual(rest, view, without, output)
    x, ctx = probe_signals(rest, view, without, pl, output)
    out: list[Array] = []
    a, b = model.slices(k)
    searched = b.stop > b.start and b.start not in model.linear
    inside = inside_of(twin) if pl.site == "feedback" else None
    flows = inside is not None and inside.place(pl.target).kind not in PUSHED
    for q in pl.effect.guess(x, residual, ctx, pl.settings):
        th = theta.copy()
        th[a] = q
        if searched and flows:
            out += flow_starts(model, k, view, th, output)
            continue
        if searched:
            th[b] = first_weights(pl, x, residual, ctx, th[a])
            out.append(th.copy())
            th[b] *= 0.3
        out.append(th)
    if flows:
        return out
    weighed = balanced(model, k, view, theta, x, ctx) if pl.site == "feedback" else []
    back = bent_back(model, k, theta, [th[a] for th in out][:2], x=x, residual=residual, ctx=ctx)
    out = [*weighed, *back, *out]
    if not twin.static:
        # the re-fitted base may compensate the effect, so the engineer's own base is a start as well
        given = twin.start(view.recording)
        if not np.allclose(given, theta[: model.n_base], rtol=1e-3, atol=0.0):
            out += _from_believed(model, rest, k, view, out[len(weighed) :][:2], given)
    return out


def _from_believed(model: Model, rest: Model, k: int, view: View, found: Sequence[Array], given: Array) -> list[Array]:
    """Return the starts on the engineer's base with weights fitted again there; ``rest`` is without effect ``k``.

    They are the guesses ``found``, and the first two from the residual there: a base that has slowed down to imitate a
    delay shows too short a delay.
    """
    pl = model.placed[k]
    a, b = model.slices(k)
    out: list[Array] = []
    believed = found[0].copy()
    believed[: model.n_base] = given
    without = rest.carry(model, believed, view.recording)
    x, ctx = probe_signals(rest, view, without, pl, pl.outputs[0])
    residual = full_residual(rest, view, without, pl.outputs[0])
    if not (np.all(np.isfinite(residual)) and np.all(np.isfinite(x))):
        return []  # beside the effects present that base runs away
    guesses = pl.effect.guess(x, residual, ctx, pl.settings)
    own = [believed.copy() for _ in guesses[:2]]
    for th, q in zip(own, guesses, strict=False):
        th[a] = q
    for th in (*found, *own):
        other = th.copy()
        other[: model.n_base] = given
        if b.stop > b.start and b.start not in model.linear:
            without = rest.carry(model, other, view.recording)
            output = pl.outputs[0]
            residual = full_residual(rest, view, without, output)
            x, ctx = probe_signals(rest, view, without, pl, output)
            other[b] = first_weights(pl, x, residual, ctx, other[a])
        out.append(other)
    return out


def bent_back(
    model: Model, k: int, theta: Array, guesses: Sequence[Array], *, x: Array, residual: Array, ctx: Context
) -> list[Array]:
    """Return starts at the guesses of effect ``k`` with the base at its optimum beside the effect, to first order.

    A base that compensated the effect and the effect itself must move together: each alone increases the cost.
    """
    pl = model.placed[k]
    searched = [i for i in model.nonlinear if i < model.n_base]
    a, b = model.slices(k)
    out: list[Array] = []
    if ctx.bends is None or ctx.bends.shape[1] != len(searched):
        return out
    rows = thin(ctx.keep, 20_000)
    for q in guesses:
        if pl.effect.basis is not None:
            columns = pl.effect.basis(x, ctx, q, pl.settings)
        else:
            assert pl.effect.apply is not None
            columns = (pl.effect.apply(x, ctx, q, pl.settings) - x)[:, None]
        if columns.shape[1] == 0 or not np.all(np.isfinite(columns)):
            continue
        columns = np.stack([ctx.to_output(np.ascontiguousarray(c)) for c in columns.T], axis=1)
        w, _ = least_squares(
            np.column_stack([columns[rows], np.ones(rows.size), ctx.bends[rows]]), residual[rows], 1e-9
        )
        other = theta.copy()
        other[a] = q
        if pl.effect.basis is not None:
            other[b] = w[: b.stop - b.start]
        for i, shift in zip(searched, w[columns.shape[1] + 1 :], strict=True):
            other[i] = shifted(model.parameters[i], theta[i], float(shift))
        out.append(other)
    return out


def first_weights(pl: Placed, x: Array, residual: Array, ctx: Context, q: Array) -> Array:
    """Return the weights that fit the residual best to first order, on the recorded course of ``x``."""
    basis = pl.effect.basis
    assert basis is not None
    columns = basis(x, ctx, q, pl.settings)
    if pl.site != "output":
        columns = np.stack([ctx.to_output(np.ascontiguousarray(c)) for c in columns.T], axis=1)
    k = thin(ctx.keep, 20_000)
    line = np.ones((k.size, 1)) if pl.site == "output" else np.stack([np.ones(k.size), x[k]], axis=1)
    if pl.site == "feedback":
        line = np.column_stack([np.ones(k.size), *(c[k] for c in base_moves(x, ctx))])
    free = [line] if ctx.bends is None else [line, ctx.bends[k]]
    w, _ = least_squares(np.column_stack([columns[k], *free]), residual[k], 1e-5)
    return w[: columns.shape[1]]


def full_residual(model: Model, view: View, theta: Array, output: str) -> Array:
    """Return measured minus simulated over the whole recording (n,), zero outside the view."""
    full = view.recording.outputs[output] - model.whole(view, theta)[output]
    return np.where(view.mask, _bounded(full, view.recording.outputs[output]), 0.0)


def _seen(model: Model, view: View, theta: Array, output: str) -> Array:
    """Return measured minus simulated everywhere (n,), also outside the view.

    The simulation is a single run, or restarts in every gap of the view for a twin that restarts.
    """
    residual = view.recording.outputs[output] - model.whole(view, theta)[output]
    gaps = tuple((a, b) for a, b in runs(~view.mask) if b - a > 2 * view.init + 16)
    if model.twin.restart and gaps:
        rest = View(view.recording, gaps, view.init)
        key = ("gaps", model.key, theta.tobytes(), output)
        in_gaps = remember(view.memo, key, lambda: model.residual(rest, theta, (output,))[output])
        residual = np.where(view.mask, residual, 0.0)
        residual[rest.index] = in_gaps
    return residual


def _bounded(residual: Array, measured: Array) -> Array:
    """Return ``residual`` (n,), or zero if the simulation diverged (a softening spring beyond its peak)."""
    most = 1e3 * float(np.max(np.abs(measured)))
    return np.where(np.abs(residual) <= most, residual, 0.0)


def course(model: Model, view: View, theta: Array, output: str) -> Array:
    """Return the recorded position (n,) on which forces depend."""
    x = moved(model, view, theta, output)
    return travelled(x, view.recording.dt, model.twin.counted) if model.twin.counted else x


def moved(model: Model, view: View, theta: Array, output: str) -> Array:
    """Return the recorded motion (n,) of the plant itself: measured less the model's additions behind it (steps)."""
    measured = view.recording.outputs[output]
    behind = [p for p in model.placed if p.site == "output" and p.effect.kind == "add" and output in p.outputs]
    if not behind:
        return measured
    plant = Model(model.twin, [p for p in model.placed if p not in behind])
    plain = plant.carry(model, theta, view.recording)
    added = model.whole(view, theta)[output] - plant.whole(view, plain)[output]
    return measured - _bounded(added, measured)


MOST_BENDS = 4_000_000
"""Largest number of values (32 MB) of the outputs' derivatives with respect to the parameters."""


def bends(model: Model, view: View, theta: Array, output: str) -> Array | None:
    """Return the derivatives (n, k) of the output with respect to searched base parameters, by forward differences.

    Returns None if no parameter is searched, if they exceed ``MOST_BENDS`` values, or if one is not finite.
    """
    searched = [i for i in model.nonlinear if i < model.n_base]
    if not searched or len(searched) * view.recording.n * len(model.twin.outputs) > MOST_BENDS:
        return None

    def make() -> Array:
        near = view.near(model.started(view, theta))
        now = model.whole(near, theta)
        columns: list[list[Array]] = []
        for i in searched:
            p = model.parameters[i]
            h = 1e-3 * max(abs(theta[i]), abs(p.scale) if np.isfinite(p.scale) else 0.0, 1e-12)
            shifted = theta.copy()
            shifted[i] = theta[i] + h if theta[i] + h <= p.hi else theta[i] - h
            moved = model.whole(near, shifted)
            columns.append([(moved[o] - now[o]) / (shifted[i] - theta[i]) for o in model.twin.outputs])
        return np.ascontiguousarray(np.transpose(columns, (1, 2, 0)))

    at = model.twin.outputs.index(output)
    found = remember(view.memo, ("bends", model.key, theta.tobytes()), make)[at]
    return found if np.all(np.isfinite(found)) else None


OVERFLOW = 1e100
"""Size of a number above which a simulation or a response has diverged: its square must stay finite."""


def _finite(x: Array) -> Array:
    """Return ``x`` with zero where it diverged."""
    return np.where(np.abs(x) < OVERFLOW, x, 0.0)


def probe_signals(model: Model, view: View, theta: Array, pl: Placed, output: str) -> tuple[Array, Context]:
    """Return the signal (n,) on which a placed effect would act in ``model``, or that would drive it, and its context.

    The context has the view as mask, the declared noise, and the path to the output. Where a simulation or a response
    has diverged, outside of what is scored, they are zero.
    """
    x, ctx = _probe(model, view, theta, pl, output)
    through = ctx.through
    believed = None if ctx.believed is None else _finite(ctx.believed)
    if through is not None:
        ctx = replace(ctx, through=lambda change: _finite(through(change)))
    signals = {s: _finite(v) if s == "velocity" else v for s, v in ctx.signals.items()}
    return _finite(x), replace(ctx, believed=believed, signals=signals)


def _probe(model: Model, view: View, theta: Array, pl: Placed, output: str) -> tuple[Array, Context]:
    twin = model.twin
    run = view_run(twin, view)
    ctx = make_context(twin, run, pl.target if pl.site == "input" else output, output)
    measured = run.measured[output]
    everywhere = _bounded(_seen(model, view, theta, output), measured)
    signals = ctx.signals
    if pl.site == "feedback" and "velocity" in run.measured:
        signals = {**signals, "velocity": run.measured["velocity"]}
    ctx = replace(
        ctx,
        mask=view.mask,
        noise=view.recording.noise.get(output),
        measured=measured,
        everywhere=everywhere,
        signals=signals,
        bends=bends(model, view, theta, output),
    )
    base = theta[: model.n_base]
    if pl.site == "output" and not (twin.static and pl.effect.kind == "add"):
        given = theta.copy()
        given[: model.n_base] = twin.start(view.recording)
        ctx = replace(ctx, believed=model.whole(view, given)[output])
    inside = inside_of(twin) if pl.site == "feedback" else None
    if inside is not None:
        position, velocity = inside.course(run, base, pl.target)
        through = inside.through(run, pl.target, base, output)
        facts = {**ctx.facts, PAIRS: inside.place(pl.target).pairs}
        if inside.place(pl.target).unit in TEMPERATURES:
            facts[KELVIN] = (float(inside.place(pl.target).unit == "K"),)
        if inside.place(pl.target).kind in ("storage", "storages"):
            facts[RANGES] = inside.storage_ranges(run, base, pl.target, view.mask)
        return position, replace(ctx, signals={**signals, "velocity": velocity}, through=through, facts=facts)
    if pl.site == "input" or pl.site == "feedback":
        through = twin.through(run, pl.target if pl.site == "input" else "", base, output)
        ctx = replace(ctx, through=through)
        if isinstance(twin, CascadeTwin) and pl.target == BETWEEN:
            drive = Signal(run.signals[twin.inputs[0]], {}, twin.inputs)
            return twin.between(run, drive, base).value, ctx
        return (run.signals[pl.target] if pl.site == "input" else course(model, view, theta, output)), ctx
    drive = twin.drive(output)
    if twin.static and drive and pl.effect.kind == "add":
        return run.signals[drive], replace(ctx, through=twin.through(run, drive, base, output))
    return model.whole(view, theta)[output], ctx
