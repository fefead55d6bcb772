"""Carries signals through the chain of a twin and its placed effects: one pass, and the start states that it needs.

Order of one pass: input effects by stage, base physics (with feedback effects inside), output effects by stage.
On a static twin an additive effect sits at the output and is driven by the input of that output, so that its
weights are in output units and linear: input or output placement is the same thing there.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sim_devices.physics.effect import STAGES, Array, Context, Settings
from tools.mismatch.placed import Placed
from tools.mismatch.twins.base import Force, Path, Run, Signal, Twin, fold
from tools.mismatch.twins.cascade import BETWEEN, CascadeTwin
from tools.mismatch.twins.dynamic import DynamicTwin
from tools.mismatch.twins.linear import roughness
from tools.mismatch.twins.memo import remember
from tools.mismatch.twins.ode import inside_of

START_PASSES = 8
"""Most passes that estimate start states behind effects at an output. Each pass corrects for these effects."""
DESIGN_PASSES = 3
"""The same for columns, whose weights are solved again at the run that they give, and where a pass is a run."""
MOST_CURVES = 12
"""Most weights behind an output whose columns are part of its start states. Those of a loop of twenty elements cost ten
times as much as its fit."""
SETTLED = 0.01
"""Change of an output by a pass, as a share of the noise of its record, below which no other is made."""
LEAST_CHANGE = 1e-5
"""The same as a share of its range."""


@dataclass(frozen=True)
class Pass:
    """Says how a pass through the chain is made: at which ``theta``, and what stays a column."""

    theta: Array
    join: bool
    """True if weights are multiplied with their columns where the columns arise."""
    folded: set[int] | None = None
    """Collects the parameters whose columns cannot stay linear; None if nobody asks."""


@dataclass(frozen=True, eq=False)
class Chain:
    """Combines a twin with placed effects. ``slices``: per effect those of theta with its nonlinear parameters and its
    weights."""

    twin: Twin
    placed: tuple[Placed, ...]
    slices: tuple[tuple[slice, slice], ...]

    @cached_property
    def order(self) -> list[int]:
        """Return the numbers of the effects in the order of the chain's stages, then as given."""
        return sorted(range(len(self.placed)), key=lambda k: STAGES.index(self.placed[k].stage))

    @property
    def bends(self) -> bool:
        """Return True if an output passes through an effect that is not linear."""
        return any(p.site == "output" and p.effect.driven and not p.effect.is_linear for p in self.placed)

    def courses(
        self,
        run: Run,
        how: Pass,
        given: Mapping[str, Signal] | None = None,
        beside: Sequence[Force] = (),
        only: Collection[str] | None = None,
    ) -> tuple[dict[str, Signal], dict[str, Signal]]:
        """Return the outputs behind their effects, and in front of them."""
        how = replace(how, theta=np.asarray(how.theta, np.float64))
        folded = how.folded
        inputs, forces = self.driven(run, how, given)
        if folded is not None and forces:
            for f in forces:
                folded.update(range(f.first_weight, f.first_weight + f.weights.size))
        every = [*forces, *beside]
        outputs, run = self.started(run, inputs, how, every)
        if only is not None:
            outputs = {o: s for o, s in outputs.items() if o in only}
        if forces and folded is not None:
            folded.update(j for s in inputs.values() for j in s.columns)
        return self._behind(run, inputs, outputs, how)[0], outputs

    def started(
        self, run: Run, inputs: Mapping[str, Signal], how: Pass, forces: Sequence[Force]
    ) -> tuple[dict[str, Signal], Run]:
        """Return the outputs in front of their effects, and the run with what its start states are read off.

        Effects at an output show a start state late or bent. Linear ones are part of the twin's own equations for it;
        the others are taken off the measured outputs, pass by pass.
        """
        inside = inside_of(self.twin)
        paths = self._paths(run, how.theta, forces)
        run = replace(run, bent=self.bends, paths=paths)
        reads = bool(run.window) and not forces and isinstance(self.twin, DynamicTwin | CascadeTwin)
        if reads:
            run = self._with_beside(run, how.theta, {})
        outputs = self.twin.respond(run, inputs, how.theta, forces, how.join)
        if not run.window:
            return outputs, run
        if reads and self.curved:

            def carried(outputs: dict[str, Signal], before: Run) -> Started:
                now = self._with_beside(before, how.theta, outputs)
                return self.twin.respond(now, inputs, how.theta, forces, how.join), now

            most = START_PASSES if how.join else DESIGN_PASSES
            return settle((outputs, run), carried, how.theta, most, grows=False)
        before = len(run.starts) > 1 or not all(p.is_linear for p in paths.values())
        if paths and before and (inside is not None or forces):
            run = replace(run, about={o: outputs[o].value for o in paths}, memo=_without_runs(run))
            return self.twin.respond(run, inputs, how.theta, forces, how.join), run
        if not (inside.integrates if inside is not None else self.twin.restart):
            return outputs, run
        recorded, behind = run, self._behind(run, inputs, outputs, how)[1]
        if not behind:
            return outputs, run

        def read(outputs: dict[str, Signal], before: Run) -> Started:
            now = before_effects(recorded, self._behind(before, inputs, outputs, how)[1])
            return self.twin.respond(now, inputs, how.theta, forces, how.join), now

        return settle((outputs, run), read, how.theta, DESIGN_PASSES, grows=True)

    def _behind(
        self, run: Run, inputs: Mapping[str, Signal], outputs: Mapping[str, Signal], how: Pass
    ) -> tuple[dict[str, Signal], dict[str, Array]]:
        """Return the outputs behind their effects, and the contributions (n,) of effects driven by an output.

        The contributions are needed where states restart from outputs that were measured behind these effects.
        """
        found, change = dict(outputs), dict[str, Array]()
        inside = inside_of(self.twin)
        for k in self.order:
            pl = self.placed[k]
            if pl.site != "output":
                continue
            for o in pl.outputs:
                if o not in found:
                    continue
                drive = self.twin.drive(o)
                by = inputs[drive] if self.twin.static and drive else None
                was = found[o]
                around = run.beside.get(o, ()) if self.curved else ()
                now = self._pass(run, k, was, by, o, how, kept=around)
                # with weights the outputs of a linear twin would be affine in them no more
                afresh = inside.integrates if inside is not None else self.twin.restart and not pl.parts.weights
                linear = o in run.paths and run.paths[o].is_linear
                if afresh and (pl.effect.driven or inside is not None) and not linear:
                    # the start states depend on it
                    if how.folded is not None:
                        how.folded.update(now.columns)
                    now = fold(now, how.theta)
                    if o not in run.paths:
                        change[o] = change.get(o, 0.0) + now.value - fold(was, how.theta).value
                found[o] = now
        return {o: fold(s, how.theta) if how.join else s for o, s in found.items()}, change

    @cached_property
    def curved(self) -> bool:
        """Return True if start states are read behind curves or loops, whose columns follow the run and so the weights.

        The weights are still linear parameters: they are solved again at the run that they give.
        """
        return any(self._curves(o) for o in self.twin.outputs)

    def _curves(self, output: str) -> bool:
        """Return True if an output passes through driven effects, and all of these have weights, of which few."""
        if not isinstance(self.twin, DynamicTwin | CascadeTwin):
            return False
        driven = [p for p in self.placed if p.site == "output" and output in p.outputs and p.effect.driven]
        few = sum(len(p.parts.weights) for p in driven) <= MOST_CURVES
        return bool(driven) and few and all(p.effect.kind == "add" for p in driven)

    def _with_beside(self, run: Run, theta: Array, outputs: Mapping[str, Signal]) -> Run:
        """Return the run of a linear twin with the columns of what is added behind each output.

        A drift or a step is part of what was measured, and of no start state; nor is what a curve or a loop adds, whose
        columns are those at an earlier run (``outputs``; none yet: they are left out).
        """
        found: dict[str, dict[int, Array]] = {}
        tokens: list[object] = []
        how = Pass(theta, False)
        for o in self.twin.outputs:
            behind = [k for k in self.order if self.placed[k].site == "output" and o in self.placed[k].outputs]
            still = Signal(np.zeros(run.t.size))
            if self._curves(o):
                if o not in outputs:
                    continue
                still = fold(outputs[o], theta)
            elif any(self.placed[k].effect.driven and self.placed[k].effect.kind != "linear" for k in behind):
                continue
            kept = {j for k in behind for j in range(self.slices[k][1].start, self.slices[k][1].stop)}
            for k in behind:
                still = self._pass(run, k, still, None, o, how, kept=kept)
            if still.columns:
                found[o] = dict(still.columns)
                tokens.append((o, still.token))
        return replace(run, beside=found, beside_token=tuple(tokens))

    def _paths(self, run: Run, theta: Array, forces: Sequence[Force]) -> dict[str, Path]:
        """Return the paths of the outputs from which start states are read through the effects behind.

        A linear run needs linear ones; where states are found by runs, curves and loops may be driven, too, but not
        effects behind which an output stands still: it does not show the state then.
        """
        found: dict[str, Path] = {}
        inside = inside_of(self.twin)
        if not isinstance(self.twin, DynamicTwin | CascadeTwin) and inside is None:
            return found
        by_runs = bool(forces) or (inside is not None and inside.integrates)
        kinds = ("linear", "add") if by_runs else ("linear",)
        for o in self.twin.outputs:
            behind = [k for k in self.order if self.placed[k].site == "output" and o in self.placed[k].outputs]
            behind = [k for k in behind if self.placed[k].effect.driven]
            if behind and all(self.placed[k].effect.kind in kinds for k in behind):
                found[o] = self._path(run, behind, o, theta)
        return found

    def _path(self, run: Run, behind: Sequence[int], output: str, theta: Array) -> Path:
        how = Pass(theta, True)

        def carry(x: Array) -> Array:
            for k in behind:
                # no token tells these signals apart
                x = self._pass(run.head(x.size), k, Signal(x), None, output, how).value
            return x

        token: list[object] = []
        for pl, (q, w) in ((self.placed[k], self.slices[k]) for k in behind):
            token += [pl.effect.form, theta[q].tobytes(), theta[w].tobytes(), frozen(pl.settings)]
        is_linear = all(self.placed[k].effect.kind == "linear" for k in behind)
        return Path(carry, tuple(token), is_linear)

    def driven(
        self, run: Run, how: Pass, given: Mapping[str, Signal] | None = None
    ) -> tuple[dict[str, Signal], list[Force]]:
        """Return the excitation of the base physics: inputs behind their effects, and forces."""
        inputs = dict(given) if given is not None else {s: Signal(run.signals[s], {}, (s,)) for s in self.twin.inputs}
        for k in sorted(self.order, key=lambda k: self.placed[k].target == BETWEEN):
            pl = self.placed[k]
            if pl.site == "input":
                if pl.target == BETWEEN and BETWEEN not in inputs and isinstance(self.twin, CascadeTwin):
                    inputs[BETWEEN] = self.twin.between(run, inputs[self.twin.inputs[0]], how.theta)
                inputs[pl.target] = self._pass(run, k, inputs[pl.target], None, pl.outputs[0], how)
        return inputs, [self.force(k, how.theta) for k in self.order if self.placed[k].site == "feedback"]

    def force(self, k: int, theta: Array) -> Force:
        """Return the placed effect ``k`` as a force inside the equations."""
        pl = self.placed[k]
        a, b = self.slices[k]
        return Force(pl.effect, pl.settings, theta[a], theta[b], b.start, pl.target)

    def _pass(
        self, run: Run, k: int, x: Signal, by: Signal | None, output: str, how: Pass, *, kept: Collection[int] = ()
    ) -> Signal:
        """Return ``x`` behind placed effect ``k``; the columns ``kept`` go round a driven effect with weights."""
        theta = how.theta
        pl, effect = self.placed[k], self.placed[k].effect
        a, b = self.slices[k]
        q = theta[a]
        ctx = make_context(self.twin, run, pl.target if pl.site == "input" else output, output)
        key = (effect.form, pl.target, output, q.tobytes(), frozen(pl.settings))

        gain = self.twin.input_gain(pl.target, theta) if pl.site == "input" else 1.0

        def collapse(s: Signal) -> Signal:
            if how.folded is not None:
                how.folded.update(s.columns)
            return fold(s, theta, gain)

        if effect.kind == "linear":
            apply = effect.apply
            assert apply is not None
            through = apply
            x = x.map(lambda v: through(v, ctx, q, pl.settings), key)
            if effect.basis is None:
                return x
        if effect.kind == "nonlinear":
            apply = effect.apply
            assert apply is not None
            s = collapse(x)
            value = remember(run.memo, (key, s.token), lambda: apply(s.value, ctx, q, pl.settings))
            return Signal(value, {}, (*s.token, key))
        basis = effect.basis
        assert basis is not None
        if effect.driven and effect.kind != "linear":
            around = {j: c for j, c in x.columns.items() if j in kept} if by is None else {}
            s = by if by is not None else replace(x, columns={j: c for j, c in x.columns.items() if j not in around})
            s = collapse(s)
            if by is None:
                x = replace(s, columns=around)
                s = fold(x, theta)
        else:
            s = Signal(x.value, {}, ("undriven",))
        columns = remember(run.memo, (key, s.token), lambda: np.asfortranarray(basis(s.value, ctx, q, pl.settings)))
        if how.join and pl.site == "output":
            return Signal(x.value + columns @ theta[b], x.columns, (*x.token, key, theta[b].tobytes()))
        return x.plus({b.start + i: columns[:, i] for i in range(columns.shape[1])}, key)


Started = tuple[dict[str, Signal], Run]


def settle(
    first: Started, again: Callable[[dict[str, Signal], Run], Started], theta: Array, most: int, *, grows: bool
) -> Started:
    """Return the outputs and the run of the last pass of ``again`` at ``theta``, of at most ``most``.

    Unless the change by a pass may grow (``grows``), that pass is not used: the start state is hardly seen behind its
    effects, and passes lead away from it.
    """
    last, was = first, np.inf
    measured = first[1].scale
    least = {o: max(SETTLED * roughness(measured[o], first[1].lasting, o), LEAST_CHANGE) for o in first[0]}
    for _ in range(most):
        outputs, run = again(*last)
        pairs = {o: (fold(last[0][o], theta).value, fold(s, theta).value) for o, s in outputs.items()}
        shares = {o: float(np.max(np.abs(b - a)) / max(np.ptp(b), 1e-300)) for o, (a, b) in pairs.items()}
        change = max(shares.values())
        if not (change < was or grows):
            break
        last, was = (outputs, run), change
        if all(share <= least[o] for o, share in shares.items()):
            break
    return last


def before_effects(run: Run, behind: Mapping[str, Array]) -> Run:
    """Return the run with its outputs as they were before the effects, which contributed ``behind`` (n,).

    Start states are read off these outputs.
    """
    before = {o: x - behind[o] if o in behind else x for o, x in run.measured.items()}
    return replace(run, measured=before, recorded=run.scale, memo=_without_runs(run))


def _without_runs(run: Run) -> dict[object, object]:
    """Return the cache of a run without what depends on its measured outputs."""
    return {"lasting": run.lasting}


def make_context(twin: Twin, run: Run, target: str, output: str) -> Context:
    """Return the context of an effect on this run."""
    drive, facts = twin.drive(output), twin.facts(output)
    return Context(run.t, run.dt, run.signals, target, output, drive, run.afresh, None, None, facts)


def frozen(settings: Settings) -> tuple[object, ...]:
    return tuple(sorted(settings.items()))
