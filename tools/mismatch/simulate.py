"""A twin with effects placed in its chain: parameters, simulation of a view, design columns for exact solving.

Order of one pass: input effects by stage, base physics (with feedback effects inside), output effects by stage.
On a static twin an additive effect sits at the output and is driven by the input of that output, so that its
weights are in output units and linear: input or output placement is the same thing there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np

from sim_devices.physics.effect import (
    STAGES,
    Array,
    Context,
    Effect,
    Human,
    Parameter,
    Parts,
    Settings,
    Stage,
)
from sim_devices.physics.statistics import least_squares, thin
from tools.mismatch.recording import Recording
from tools.mismatch.twins.base import Force, Run, Signal, Twin, fold, remember


@dataclass(frozen=True)
class Placed:
    """One effect at one place of the chain.

    ``site``: where in the flow; ``target``: the input or output signal there; ``outputs``: whose residual it may
    change (several for shared effects); ``note`` lists places that the recording cannot tell from this one.
    """

    effect: Effect
    site: Literal["input", "output", "feedback"]
    target: str
    stage: Stage
    outputs: tuple[str, ...]
    settings: Settings = field(default_factory=dict[str, tuple[float, ...]])
    note: str = ""

    @property
    def parts(self) -> Parts:
        """Its parameters."""
        return self.effect.parts(self.settings)

    @property
    def label(self) -> str:
        """Name for parameter lists and logs, e.g. ``creep[displacement]``."""
        return f"{self.effect.name}[{self.target}]"


@dataclass(frozen=True)
class View:
    """Sample ranges of a recording to compare on.

    ``init`` samples at each start (of the recording, or of every range where the twin restarts) may set the state
    and are not scored; ``lead`` samples before a range may help to set it (a guard gap that nobody scores).
    ``memo`` remembers columns that do not change between calls; do not share it between processes.
    """

    recording: Recording
    ranges: tuple[tuple[int, int], ...]
    init: int = 0
    lead: int = 0
    memo: dict[object, object] = field(default_factory=dict[object, object], compare=False, repr=False)

    @property
    def index(self) -> np.ndarray:
        """Samples of the view, concatenated ranges, int64 (m,)."""
        return np.concatenate([np.arange(a, b) for a, b in self.ranges])

    def scored(self, twin: Twin) -> np.ndarray:
        """(m,) bool: samples that count (not used to set a state)."""
        if self.init == 0:
            return np.ones(sum(b - a for a, b in self.ranges), np.bool_)
        first = 0 if twin.restart else self.init
        out: list[np.ndarray] = []
        for a, b in self.ranges:
            i = np.arange(a, b)
            out.append(i >= a + self.init if twin.restart else i >= first)
        return np.concatenate(out)

    def measured(self, output: str) -> Array:
        """(m,) the recorded output on the view."""
        return self.recording.outputs[output][self.index]

    @staticmethod
    def whole(recording: Recording, init: int = 0) -> View:
        """Everything."""
        return View(recording, ((0, recording.n),), init)


@dataclass(frozen=True)
class Free:
    """One entry of the parameter vector."""

    name: str
    unit: str
    lo: float
    hi: float
    log: bool
    scale: float
    linear: bool
    placed: int
    """-1 for base parameters, else the index of the placed effect."""


@dataclass(frozen=True)
class Design:
    """Outputs on a view as ``constant + columns @ theta[linear]`` for the nonlinear parameters given.

    ``columns[output]`` (m, len(linear[output])): only the parameters that this output sees.
    ``penalty`` (rows, len(model.linear)): smoothness rows over all linear parameters, in ``model.linear`` order.
    """

    constant: Mapping[str, Array]
    columns: Mapping[str, Array]
    linear: Mapping[str, tuple[int, ...]]
    penalty: Array


class Model:
    """A twin with placed effects (kept in chain order as far as stages order them, then as given)."""

    def __init__(self, twin: Twin, placed: Sequence[Placed] = ()) -> None:
        self.twin = twin
        self.placed = tuple(placed)
        free: list[Free] = []
        self._slices: list[tuple[slice, slice]] = []
        base = [_free(p, twin.units, "", "", "", -1) for p in twin.parameters]
        free.extend(base)
        for k, pl in enumerate(self.placed):
            parts = pl.parts
            a = len(free)
            b = a + len(parts.nonlinear)
            c = b + len(parts.weights)
            u_out = twin.units.get(pl.outputs[0], "")
            u_in = twin.units.get(twin.drive(pl.outputs[0]) or pl.target, "")
            u_tgt = twin.units.get(pl.target, "")
            if pl.site == "input":
                u_in = u_tgt
            for p in (*parts.nonlinear, *parts.weights):
                free.append(_free(p, twin.units, u_in, u_out, pl.label + ".", k))
            self._slices.append((slice(a, b), slice(b, c)))
        self.order = sorted(range(len(self.placed)), key=lambda k: STAGES.index(self.placed[k].stage))
        self._free = tuple(free)
        survived = self._find_linear()
        self.parameters = tuple(replace(f, linear=i in survived) for i, f in enumerate(free))
        self.linear = tuple(i for i, f in enumerate(self.parameters) if f.linear)
        self.nonlinear = tuple(i for i, f in enumerate(self.parameters) if not f.linear)

    # -- parameters ---------------------------------------------------------------------------------

    @property
    def n_base(self) -> int:
        """Number of base parameters; they come first in theta."""
        return len(self.twin.parameters)

    def slices(self, k: int) -> tuple[slice, slice]:
        """Where the nonlinear parameters and the weights of placed effect ``k`` sit in theta."""
        return self._slices[k]

    def start(self, recording: Recording) -> Array:
        """Theta with the base as given, effects absent as far as that is expressible (weights zero, nonlinear
        parameters in the middle of their bounds)."""
        theta = np.zeros(len(self.parameters))
        theta[: self.n_base] = self.twin.start(recording)
        for k, pl in enumerate(self.placed):
            s, _ = self._slices[k]
            theta[s] = [_middle(p) for p in pl.parts.nonlinear]
        return theta

    def carry(self, other: Model, theta: Array, recording: Recording) -> Array:
        """Theta of ``other`` (a model with a subset of these effects) as a start for this one, by effect."""
        mine = self.start(recording)
        mine[: self.n_base] = theta[: other.n_base]
        left = list(range(len(other.placed)))
        for k, pl in enumerate(self.placed):
            hit = next((j for j in left if other.placed[j] == pl or other.placed[j] is pl), None)
            if hit is not None:
                left.remove(hit)
                for a, b in zip(self._slices[k], other.slices(hit), strict=True):
                    mine[a] = theta[b]
        return mine

    def starts(self, k: int, view: View, theta: Array) -> list[Array]:
        """Theta with placed effect ``k`` at each of its guesses (others kept), from the residual at ``theta``
        without effect ``k``."""
        pl = self.placed[k]
        rest = Model(self.twin, [p for j, p in enumerate(self.placed) if j != k])
        without = rest.carry(self, theta, view.recording)
        output = pl.outputs[0]
        residual = full_residual(rest, view, without)[output]
        x, ctx = probe_signals(rest, view, without, pl, output)
        out: list[Array] = []
        a, b = self._slices[k]
        searched = b.stop > b.start and b.start not in self.linear
        for q in pl.effect.guess(x, residual, ctx, pl.settings):
            th = theta.copy()
            th[a] = q
            if searched:
                th[b] = first_weights(pl, x, residual, ctx, th[a])
                out.append(th.copy())
                th[b] *= 0.3
            out.append(th)
        if not self.twin.static:
            # an effect that the re-fitted base has bent itself around: start from what the engineer believes too
            given = self.twin.start(view.recording)
            if not np.allclose(given, theta[: self.n_base], rtol=1e-3, atol=0.0):
                out += self._from_believed(k, view, out[:2], given)
        return out

    def _from_believed(self, k: int, view: View, starts: Sequence[Array], given: Array) -> list[Array]:
        """The same starts on the engineer's base, searched weights met anew there."""
        pl = self.placed[k]
        a, b = self._slices[k]
        rest = Model(self.twin, [p for j, p in enumerate(self.placed) if j != k])
        out: list[Array] = []
        for th in starts:
            other = th.copy()
            other[: self.n_base] = given
            if b.stop > b.start and b.start not in self.linear:
                without = rest.carry(self, other, view.recording)
                output = pl.outputs[0]
                residual = full_residual(rest, view, without)[output]
                x, ctx = probe_signals(rest, view, without, pl, output)
                other[b] = first_weights(pl, x, residual, ctx, other[a])
            out.append(other)
        return out

    def human(self, theta: Array) -> dict[str, list[Human]]:
        """Parameters for the report: key "base" and each effect's label."""
        out: dict[str, list[Human]] = {"base": list(self.twin.human(theta[: self.n_base]))}
        for k, pl in enumerate(self.placed):
            a, b = self._slices[k]
            p = np.concatenate([theta[a], theta[b]])
            g = self.twin.sensitivity(pl.outputs[0], theta[: self.n_base])
            if pl.effect.report is not None:
                out[pl.label] = list(pl.effect.report(p, pl.settings, g))
            else:
                names = self.parameters[a.start : b.stop]
                out[pl.label] = [
                    Human(f.name.rsplit(".", 1)[-1], float(v), f.unit) for f, v in zip(names, p, strict=True)
                ]
        return out

    # -- simulation ---------------------------------------------------------------------------------

    def simulate(self, view: View, theta: Array) -> dict[str, Array]:
        """Every output of the twin on the view, (m,) each: free-run, no measured output but for start states."""
        index = view.index
        return {o: s.value[index] for o, s in self._flow(view_run(self.twin, view), theta, True).items()}

    def residual(self, view: View, theta: Array) -> dict[str, Array]:
        """Measured minus simulated on the view."""
        return {o: view.measured(o) - y for o, y in self.simulate(view, theta).items()}

    def excused(self, view: View, output: str) -> np.ndarray:
        """(m,) bool: samples that a placed effect takes as its own events (bursts); not to be fitted or scored."""
        out = np.zeros(view.recording.n, np.bool_)
        for pl in self.placed:
            if pl.effect.claims is not None and output in pl.outputs:
                out |= pl.effect.claims(pl.settings, view.recording.n)
        return out[view.index]

    def design(self, view: View, theta: Array) -> Design:
        """The affine structure at the nonlinear parameters of ``theta``; linear entries are ignored."""
        index = view.index
        flow = self._flow(view_run(self.twin, view), theta, False)
        keep = set(self.linear)
        constant: dict[str, Array] = {}
        columns: dict[str, Array] = {}
        linear: dict[str, tuple[int, ...]] = {}
        for o, s in flow.items():
            value = s.value[index]
            js = sorted(j for j in s.columns if j in keep)
            for j in s.columns:
                if j not in keep:
                    value = value + theta[j] * s.columns[j][index]
            constant[o] = value
            linear[o] = tuple(js)
            matrix = np.empty((index.size, len(js)), order="F")
            for i, j in enumerate(js):
                matrix[:, i] = s.columns[j][index]
            columns[o] = matrix
        return Design(constant, columns, linear, self._penalty)

    @cached_property
    def _penalty(self) -> Array:
        rows = self.smoothness()
        others = np.ones(len(self.parameters), np.bool_)
        others[list(self.linear)] = False
        solved = ~np.any(rows[:, others] != 0.0, axis=1)
        return rows[solved][:, list(self.linear)]

    def smoothness(self) -> Array:
        """Smoothness rows over all parameters, (rows, len(parameters)): those of the twin and of each effect."""
        n = len(self.parameters)
        own = getattr(self.twin, "penalty", None)
        blocks = [np.zeros((0, n))]
        if own is not None:
            blocks.append(np.pad(own, ((0, 0), (0, n - own.shape[1]))))
        for k, pl in enumerate(self.placed):
            penalty = pl.parts.penalty
            if penalty is not None:
                w = self._slices[k][1]
                blocks.append(np.pad(penalty, ((0, 0), (w.start, n - w.stop))))
        return np.concatenate(blocks)

    def flow(
        self, run: Run, inputs: Mapping[str, Signal], theta: Array, forces: Sequence[Force], join: bool
    ) -> dict[str, Signal]:
        """The outputs for given inputs and further forces: this model as the base physics of another."""
        return self._flow(run, theta, join, None, inputs, forces)

    def _flow(
        self,
        run: Run,
        theta: Array,
        join: bool,
        folded: set[int] | None = None,
        given: Mapping[str, Signal] | None = None,
        beside: Sequence[Force] = (),
    ) -> dict[str, Signal]:
        theta = np.asarray(theta, np.float64)
        inputs = dict(given) if given is not None else {s: Signal(run.signals[s], {}, (s,)) for s in self.twin.inputs}
        for k in self.order:
            pl = self.placed[k]
            if pl.site == "input":
                inputs[pl.target] = self._pass(run, k, inputs[pl.target], None, pl.outputs[0], theta, join, folded)
        forces = [self._force(k, theta) for k in self.order if self.placed[k].site == "feedback"]
        if folded is not None and forces:
            for f in forces:
                folded.update(range(f.first_weight, f.first_weight + f.weights.size))
        outputs = self.twin.respond(run, inputs, theta, [*forces, *beside], join)
        if forces and folded is not None:
            folded.update(j for s in inputs.values() for j in s.columns)
        for k in self.order:
            pl = self.placed[k]
            if pl.site != "output":
                continue
            for o in pl.outputs:
                if o not in outputs:
                    continue
                drive = self.twin.drive(o)
                by = inputs[drive] if self.twin.static and drive else None
                outputs[o] = self._pass(run, k, outputs[o], by, o, theta, join, folded)
        return outputs

    def _force(self, k: int, theta: Array) -> Force:
        pl = self.placed[k]
        a, b = self._slices[k]
        return Force(pl.effect, pl.settings, theta[a], theta[b], b.start)

    def _pass(
        self,
        run: Run,
        k: int,
        x: Signal,
        by: Signal | None,
        output: str,
        theta: Array,
        join: bool,
        folded: set[int] | None,
    ) -> Signal:
        pl, effect = self.placed[k], self.placed[k].effect
        a, b = self._slices[k]
        q = theta[a]
        ctx = make_context(self.twin, run, pl.target if pl.site == "input" else output, output)
        key = (effect.name, pl.target, output, q.tobytes(), _frozen(pl.settings))

        gain = self.twin.input_gain(pl.target, theta) if pl.site == "input" else 1.0

        def collapse(s: Signal) -> Signal:
            if folded is not None:
                folded.update(s.columns)
            return fold(s, theta, gain)

        if effect.kind == "linear":
            apply = effect.apply
            assert apply is not None
            return x.map(lambda v: apply(v, ctx, q, pl.settings), key)
        if effect.kind == "nonlinear":
            apply = effect.apply
            assert apply is not None
            s = collapse(x)
            value = remember(run.memo, (key, s.token), lambda: apply(s.value, ctx, q, pl.settings))
            return Signal(value, {}, (*s.token, key))
        basis = effect.basis
        assert basis is not None
        if effect.driven:
            s = collapse(by if by is not None else x)
            if s is not x and by is None:
                x = s
        else:
            s = Signal(x.value, {}, ("undriven",))
        columns = remember(run.memo, (key, s.token), lambda: np.asfortranarray(basis(s.value, ctx, q, pl.settings)))
        if join and pl.site == "output":
            return Signal(x.value + columns @ theta[b], x.columns, (*x.token, key, theta[b].tobytes()))
        return x.plus({b.start + i: columns[:, i] for i in range(columns.shape[1])}, key)

    def _find_linear(self) -> set[int]:
        """Which parameters stay linear, found by one pass over a short made-up stretch."""
        n = 64
        t = np.asarray(np.arange(n) * 1e-2, np.float64)
        wave: Array = np.sin(2 * np.pi * t / t[-1])
        names = {*self.twin.inputs, *(s for pl in self.placed for s in pl.effect.needs)}
        run = Run(
            t,
            1e-2,
            dict.fromkeys(names, wave),
            self.twin.inputs,
            dict.fromkeys(self.twin.outputs, wave),
            (0,),
            0,
            {},
        )
        theta = np.array([_middle(f) for f in self._free])
        folded: set[int] = set()
        with np.errstate(all="ignore"):
            flow = self._flow(run, theta, False, folded)
        found = {j for s in flow.values() for j in s.columns}
        return found - folded


def first_weights(pl: Placed, x: Array, residual: Array, ctx: Context, q: Array) -> Array:
    """Weights that meet the residual best to first order, on the recorded course of ``x``."""
    basis = pl.effect.basis
    assert basis is not None
    columns = basis(x, ctx, q, pl.settings)
    if pl.site != "output":
        columns = np.stack([ctx.to_output(np.ascontiguousarray(c)) for c in columns.T], axis=1)
    k = thin(ctx.keep, 20_000)
    line = np.ones((k.size, 1)) if pl.site == "output" else np.stack([np.ones(k.size), x[k]], axis=1)
    w, _ = least_squares(np.column_stack([columns[k], line]), residual[k], 1e-5)
    return w[: columns.shape[1]]


def view_run(twin: Twin, view: View) -> Run:
    """The stretch that a view needs: the whole past, since inputs before a block are known and set its memory.

    A twin that restarts does so at every range; others start at sample 0 and run through.
    """
    rec = view.recording
    starts, window = (0,), view.init
    if twin.restart:
        starts = tuple(dict.fromkeys((0, *(max(0, a - view.lead) for a, _ in view.ranges))))
        window += view.lead
    return Run(rec.t, rec.dt, rec.signals, twin.inputs, rec.outputs, starts, window, view.memo)


def make_context(twin: Twin, run: Run, target: str, output: str) -> Context:
    """What an effect sees on this run."""
    return Context(
        run.t,
        run.dt,
        run.signals,
        target,
        output,
        twin.drive(output),
        (0,),
        None,
        None,
        twin.facts(output),
    )


def full_residual(model: Model, view: View, theta: Array) -> dict[str, Array]:
    """Measured minus simulated over the whole recording (n,), zero outside the view."""
    out: dict[str, Array] = {}
    index = view.index
    for o, r in model.residual(view, theta).items():
        full = np.zeros(view.recording.n)
        full[index] = r
        out[o] = full
    return out


def view_mask(view: View) -> np.ndarray:
    """(n,) bool: samples of the recording that are in the view."""
    mask = np.zeros(view.recording.n, np.bool_)
    mask[view.index] = True
    return mask


def probe_signals(model: Model, view: View, theta: Array, pl: Placed, output: str) -> tuple[Array, Context]:
    """The signal (n,) that a placed effect would sit on in ``model`` (or be driven by), and its context with
    the view as mask, the declared noise, and the way to the output."""
    twin = model.twin
    run = view_run(twin, view)
    ctx = make_context(twin, run, pl.target if pl.site == "input" else output, output)
    measured = run.measured[output]
    mask = view_mask(view)
    everything = View(view.recording, ((0, view.recording.n),), view.init, view.lead, view.memo)
    whole = model.residual(everything if not twin.restart else view, theta)[output]
    everywhere = whole if whole.size == mask.size else None
    signals = ctx.signals
    if pl.site == "feedback" and "velocity" in run.measured:
        signals = {**signals, "velocity": run.measured["velocity"]}
    ctx = replace(
        ctx,
        mask=mask,
        noise=view.recording.noise.get(output),
        measured=measured,
        everywhere=everywhere,
        signals=signals,
    )
    base = theta[: model.n_base]
    if pl.site == "output" and not (twin.static and pl.effect.kind == "add"):
        given = theta.copy()
        given[: model.n_base] = twin.start(view.recording)
        ctx = replace(ctx, believed=model._flow(run, given, True)[output].value)
    if pl.site == "input" or pl.site == "feedback":
        through = twin.through(run, pl.target if pl.site == "input" else "", base, output)
        ctx = replace(ctx, through=through)
        return (run.signals[pl.target] if pl.site == "input" else measured), ctx
    drive = twin.drive(output)
    if twin.static and drive and pl.effect.kind == "add":
        return run.signals[drive], replace(ctx, through=twin.through(run, drive, base, output))
    return model._flow(run, theta, True)[output].value, ctx


def prepare(model: Model, view: View, theta: Array, pl: Placed) -> Placed:
    """``pl`` with its settings read from the residual of ``model`` at ``theta`` on the view.

    An effect of several outputs that has a test of its own reads them off the output that shows it best.
    """
    best: tuple[float, Settings] | None = None
    outputs = pl.outputs if pl.effect.test is not None and not pl.effect.shared else pl.outputs[:1]
    for output in outputs:
        x, ctx = probe_signals(model, view, theta, pl, output)
        residual = full_residual(model, view, theta)[output]
        settings = pl.effect.prepare(x, residual, ctx)
        share = pl.effect.test(x, residual, ctx).share if pl.effect.test is not None and len(outputs) > 1 else 0.0
        if best is None or share > best[0]:
            best = (share, settings)
    assert best is not None
    return replace(pl, settings=best[1])


def _frozen(settings: Settings) -> tuple[object, ...]:
    return tuple(sorted(settings.items()))


def _middle(p: Parameter | Free) -> float:
    lo, hi = p.lo, p.hi
    if p.log and lo > 0 and np.isfinite(hi):
        return float(np.sqrt(lo * hi))
    if np.isfinite(lo) and np.isfinite(hi):
        return 0.5 * (lo + hi)
    return float(min(max(p.scale, lo), hi))


def _free(p: Parameter, units: Mapping[str, str], u_in: str, u_out: str, prefix: str, k: int) -> Free:
    unit = p.unit.replace("{in}", u_in).replace("{out}", u_out)
    return Free(prefix + p.name, unit, p.lo, p.hi, p.log, p.scale, False, k)
