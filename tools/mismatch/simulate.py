"""Simulates a twin with effects placed in its chain: parameters, views, design columns for exact solving.

Order of one pass: input effects by stage, base physics (with feedback effects inside), output effects by stage.
On a static twin an additive effect sits at the output and is driven by the input of that output, so that its
weights are in output units and linear: input or output placement is the same thing there.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sim_devices.physics.effect import STAGES, Array, Context, Human, Settings
from tools.mismatch.placed import Free, Placed, free_entry, middle
from tools.mismatch.recording import Recording
from tools.mismatch.simulate_view import View, view_run
from tools.mismatch.twins.base import Force, Path, Run, Signal, Twin, fold
from tools.mismatch.twins.cascade import BETWEEN, CascadeTwin
from tools.mismatch.twins.dynamic import DynamicTwin
from tools.mismatch.twins.linear import roughness
from tools.mismatch.twins.memo import Nearby, remember, stored
from tools.mismatch.twins.ode import PUSHED, inside_of, weight_scale

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
class Design:
    """Expresses outputs on a view as ``constant + columns @ theta[linear]`` for given nonlinear parameters.

    ``columns[output]`` (m, len(linear[output])) has only the parameters on which this output depends.
    ``penalty`` (rows, len(model.linear)): smoothness rows over all linear parameters, in ``model.linear`` order.
    """

    constant: Mapping[str, Array]
    columns: Mapping[str, Array]
    linear: Mapping[str, tuple[int, ...]]
    penalty: Array


@dataclass(frozen=True)
class Pass:
    """Says how a pass through the chain is made: at which ``theta``, and what stays a column."""

    theta: Array
    join: bool
    """True if weights are multiplied with their columns where the columns arise."""
    folded: set[int] | None = None
    """Collects the parameters whose columns cannot stay linear; None if nobody asks."""


class Model:
    """Combines a twin with placed effects, which are kept in the order of the chain's stages, then as given."""

    def __init__(self, twin: Twin, placed: Sequence[Placed] = ()) -> None:
        self.twin = twin
        self.placed = tuple(placed)
        free: list[Free] = []
        self._slices: list[tuple[slice, slice]] = []
        base = [free_entry(p, "", "", "", -1) for p in twin.parameters]
        free.extend(base)
        for k, pl in enumerate(self.placed):
            parts = pl.parts
            a = len(free)
            b = a + len(parts.nonlinear)
            c = b + len(parts.weights)
            u_out = twin.units.get(pl.outputs[0], "")
            if pl.site == "feedback" and twin.counted:
                u_out = u_out.removesuffix("/s")  # forces depend on position
            u_in = twin.units.get(twin.drive(pl.outputs[0]) or pl.target, "")
            u_tgt = twin.units.get(pl.target, "")
            if pl.site == "input":
                u_in = u_tgt
            inside = inside_of(twin) if pl.site == "feedback" else None
            if inside is not None:
                u_in, u_out = inside.place_units(pl.target)
            for p in (*parts.nonlinear, *parts.weights):
                free.append(free_entry(p, u_in, u_out, pl.label + ".", k))
            if inside is not None and inside.place(pl.target).kind in PUSHED:
                free[c - len(parts.weights) :] = [
                    replace(f, scale=weight_scale(p.unit, *inside.force_scale(pl.target)))
                    for f, p in zip(free[c - len(parts.weights) :], parts.weights, strict=True)
                ]
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
        """Return the number of base parameters; they come first in theta."""
        return len(self.twin.parameters)

    def slices(self, k: int) -> tuple[slice, slice]:
        """Return the slices of theta with the nonlinear parameters and the weights of placed effect ``k``."""
        return self._slices[k]

    def together(self, outputs: Sequence[str]) -> tuple[str, ...]:
        """Return ``outputs`` and all others that share a parameter with one of them, in the twin's order."""
        if not self.twin.apart or any(p.site == "input" for p in self.placed):
            return self.twin.outputs
        found = set(outputs)
        while True:
            more = {o for p in self.placed if found & set(p.outputs) for o in p.outputs} - found
            if not more:
                return tuple(o for o in self.twin.outputs if o in found)
            found |= more

    def parameters_of(self, outputs: Sequence[str]) -> set[int]:
        """Return the indices of the parameters that move one of ``outputs``."""
        if set(outputs) == set(self.twin.outputs):
            return set(range(len(self.parameters)))
        m = len(self.twin.outputs)
        found = {i for i in range(self.n_base) if self.twin.outputs[i % m] in outputs}
        for k, pl in enumerate(self.placed):
            if set(pl.outputs) & set(outputs):
                found |= {i for part in self._slices[k] for i in range(part.start, part.stop)}
        return found

    def moved_by(self, i: int) -> tuple[str, ...]:
        """Return the outputs that may change with nonlinear parameter ``i`` while the linear ones are solved again.

        These are its own outputs and all that share a linear parameter with one of them, in the twin's order.
        """
        k = self.parameters[i].placed
        if not self.twin.apart or k < 0 or self.placed[k].site != "output":
            return self.twin.outputs
        found = set(self.placed[k].outputs)
        shared = [
            set(pl.outputs if pl.site == "output" else self.twin.outputs)
            for j, pl in enumerate(self.placed)
            if any(self.parameters[i].linear for part in self._slices[j] for i in range(part.start, part.stop))
        ]
        while more := [s for s in shared if s & found and s - found]:
            found.update(*more)
        return tuple(o for o in self.twin.outputs if o in found)

    def start(self, recording: Recording) -> Array:
        """Return theta with the base as given and effects absent as far as that is expressible.

        Weights are zero and nonlinear parameters in the middle of their bounds.
        """
        theta = np.zeros(len(self.parameters))
        theta[: self.n_base] = self.twin.start(recording)
        for k, pl in enumerate(self.placed):
            s, _ = self._slices[k]
            theta[s] = [middle(p) for p in pl.parts.nonlinear]
        return theta

    def carry(self, other: Model, theta: Array, recording: Recording) -> Array:
        """Return the theta of ``other`` (a model with a subset of these effects) as a start for this one, by effect."""
        start = self.start(recording)
        start[: self.n_base] = theta[: other.n_base]
        left = list(range(len(other.placed)))
        for k, pl in enumerate(self.placed):
            hit = next((j for j in left if other.placed[j] == pl or other.placed[j] is pl), None)
            if hit is not None:
                left.remove(hit)
                for a, b in zip(self._slices[k], other.slices(hit), strict=True):
                    start[a] = theta[b]
        return start

    def human(self, theta: Array) -> dict[str, list[Human]]:
        """Return the parameters for the report, under the key "base" and each effect's label."""
        out: dict[str, list[Human]] = {"base": list(self.twin.human(theta[: self.n_base]))}
        for k, pl in enumerate(self.placed):
            a, b = self._slices[k]
            p = np.concatenate([theta[a], theta[b]])
            g = self.twin.sensitivity(pl.outputs[0], theta[: self.n_base])
            if pl.site == "output" and not self.twin.static:
                g = 1.0  # driven by the output itself
            inside = inside_of(self.twin) if pl.site == "feedback" else None
            if inside is not None:
                g = inside.force_gain(pl.target, theta[: self.n_base])[0]
            if pl.effect.report is not None:
                out[pl.label] = list(pl.effect.report(p, pl.settings, g))
            else:
                names = self.parameters[a.start : b.stop]
                out[pl.label] = [
                    Human(f.name.rsplit(".", 1)[-1], float(v), f.unit) for f, v in zip(names, p, strict=True)
                ]
        return out

    @property
    def bends(self) -> bool:
        """Return True if an output passes through an effect that is not linear."""
        return any(p.site == "output" and p.effect.driven and not p.effect.is_linear for p in self.placed)

    def base_text(self, theta: Array) -> dict[str, object]:
        """Return the twin's parameters for a twin file, with the initial rest position if no measurement shows it."""
        text = dict(self.twin.to_text(theta[: self.n_base]))
        if self.bends and getattr(self.twin, "at_rest", False):
            text["x0"] = [0.0] * len(np.asarray(text["A"]))
        return text

    # -- simulation ---------------------------------------------------------------------------------

    def simulate(self, view: View, theta: Array, only: Collection[str] | None = None) -> dict[str, Array]:
        """Return the outputs on the view, (m,) each, of a free run that uses measured outputs for start states only.

        ``only`` restricts the outputs (None: all).
        """
        flow = self._courses(view_run(self.twin, view), Pass(theta, True), only=only)[0]
        return {o: view.take(s.value) for o, s in flow.items()}

    def in_front(self, view: View, theta: Array) -> dict[str, Array]:
        """Return the outputs (n,) of a free run in front of the effects at outputs."""
        outputs = self._courses(view_run(self.twin, view), Pass(theta, True))[1]
        return {o: view.take(fold(s, theta).value) for o, s in outputs.items()}

    def whole(self, view: View, theta: Array) -> dict[str, Array]:
        """Return the outputs over the whole recording (n,) from the start states that the view allows.

        They are cached, but for those of a search, which start near an earlier run.
        """

        def make() -> Array:
            flow = self._courses(view_run(self.twin, view), Pass(theta, True))[0]
            return np.stack([flow[o].value for o in self.twin.outputs])

        key = ("whole", self.key, theta.tobytes())
        found = make() if view.nearby is not None else remember(view.memo, key, make)
        return dict(zip(self.twin.outputs, found, strict=True))

    def started(self, view: View, theta: Array) -> Nearby:
        """Return the start states of a run, and how they act on it: other runs start near them; cached."""
        key = ("started", self.key, theta.tobytes())
        known = view.memo.get(key)
        if isinstance(known, Nearby):
            return known
        near = view.near()
        assert near.nearby is not None
        self.simulate(near, theta)
        stored(view.memo, key, near.nearby, near.nearby.nbytes)
        return near.nearby

    def residual(self, view: View, theta: Array, only: Collection[str] | None = None) -> dict[str, Array]:
        """Return measured minus simulated outputs on the view."""
        return {o: view.measured(o) - y for o, y in self.simulate(view, theta, only).items()}

    def excused(self, view: View, output: str) -> np.ndarray:
        """Return a mask (m,) of the samples that a placed effect claims as events; they are not fitted or scored."""
        out = np.zeros(view.recording.n, np.bool_)
        for pl in self.placed:
            if pl.effect.claims is not None and output in pl.outputs:
                out |= pl.effect.claims(pl.settings, view.recording.n)
        return out[view.index]

    def design(
        self, view: View, theta: Array, only: Collection[str] | None = None, samples: NDArray[np.int64] | None = None
    ) -> Design:
        """Return the affine structure at the nonlinear parameters of ``theta``; linear entries are ignored.

        ``only`` restricts the outputs; ``samples`` of the recording replace the whole view.
        """
        run = view_run(self.twin, view)
        if samples is not None and isinstance(self.twin, DynamicTwin) and all(p.site != "output" for p in self.placed):
            # no effect needs the course of an output
            run = replace(run, wanted=samples)
        flow = self._courses(run, Pass(theta, False), only=only)[0]
        keep = set(self.linear)
        constant: dict[str, Array] = {}
        columns: dict[str, Array] = {}
        linear: dict[str, tuple[int, ...]] = {}

        def take(x: Array) -> Array:
            if samples is None:
                return view.take(x)
            return x if x.size == samples.size else x[samples]

        for o, s in flow.items():
            value = take(s.value)
            js = sorted(j for j in s.columns if j in keep)
            for j in s.columns:
                if j not in keep:
                    value = value + theta[j] * take(s.columns[j])
            constant[o] = value
            linear[o] = tuple(js)
            matrix = np.empty((value.size, len(js)), order="F")
            for i, j in enumerate(js):
                matrix[:, i] = take(s.columns[j])
            columns[o] = matrix
        return Design(constant, columns, linear, self.penalty)

    @cached_property
    def key(self) -> tuple[object, ...]:
        """Return a key that distinguishes this model from others of the same twin."""
        return tuple((*p.effect.form, p.site, p.target, p.outputs, _frozen(p.settings)) for p in self.placed)

    @cached_property
    def penalty(self) -> Array:
        """Return the smoothness rows over ``self.linear``."""
        rows = self.smoothness()
        others = np.ones(len(self.parameters), np.bool_)
        others[list(self.linear)] = False
        solved = ~np.any(rows[:, others] != 0.0, axis=1)
        return rows[solved][:, list(self.linear)]

    def smoothness(self) -> Array:
        """Return the smoothness rows of the twin and of each effect over all parameters, (rows, len(parameters))."""
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
        """Return the outputs for given inputs and further forces, with this model as the base physics of another."""
        return self._courses(run, Pass(theta, join), inputs, forces)[0]

    def _courses(
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
        inputs, forces = self._driven(run, how, given)
        if folded is not None and forces:
            for f in forces:
                folded.update(range(f.first_weight, f.first_weight + f.weights.size))
        every = [*forces, *beside]
        outputs, run = self._started(run, inputs, how, every)
        if only is not None:
            outputs = {o: s for o, s in outputs.items() if o in only}
        if forces and folded is not None:
            folded.update(j for s in inputs.values() for j in s.columns)
        return self._behind(run, inputs, outputs, how)[0], outputs

    def _started(
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
            kept = {j for k in behind for j in range(self._slices[k][1].start, self._slices[k][1].stop)}
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
        for pl, (q, w) in ((self.placed[k], self._slices[k]) for k in behind):
            token += [pl.effect.form, theta[q].tobytes(), theta[w].tobytes(), _frozen(pl.settings)]
        is_linear = all(self.placed[k].effect.kind == "linear" for k in behind)
        return Path(carry, tuple(token), is_linear)

    def _driven(
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

    def driven(self, run: Run, theta: Array) -> Run:
        """Return the run with its inputs as they are behind their effects."""
        inputs, _ = self._driven(run, Pass(theta, True))
        behind = {s: fold(x, theta).value for s, x in inputs.items() if s in run.signals}
        return replace(run, signals={**run.signals, **behind}, memo={})

    def start_states(self, view: View, theta: Array) -> Array:
        """Return the states (s,) at the first sample of a free run of differential equations."""
        inside = inside_of(self.twin)
        assert inside is not None
        run = view_run(self.twin, view)
        how = Pass(theta, True)
        inputs, forces = self._driven(run, how)
        used = {s: fold(x, theta) for s, x in inputs.items()}
        _, run = self._started(run, inputs, how, forces)
        return inside.states(run, used, theta, forces)[0][0]

    def force(self, k: int, theta: Array) -> Force:
        """Return the placed effect ``k`` as a force inside the equations."""
        pl = self.placed[k]
        a, b = self._slices[k]
        return Force(pl.effect, pl.settings, theta[a], theta[b], b.start, pl.target)

    def _pass(
        self, run: Run, k: int, x: Signal, by: Signal | None, output: str, how: Pass, *, kept: Collection[int] = ()
    ) -> Signal:
        """Return ``x`` behind placed effect ``k``; the columns ``kept`` go round a driven effect with weights."""
        theta = how.theta
        pl, effect = self.placed[k], self.placed[k].effect
        a, b = self._slices[k]
        q = theta[a]
        ctx = make_context(self.twin, run, pl.target if pl.site == "input" else output, output)
        key = (effect.form, pl.target, output, q.tobytes(), _frozen(pl.settings))

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

    def _find_linear(self) -> set[int]:
        """Return which parameters stay linear, found by one pass over a short made-up stretch."""
        n = 64
        t = np.asarray(np.arange(n) * 1e-2, np.float64)
        wave: Array = np.sin(2 * np.pi * t / t[-1])
        names = {*self.twin.inputs, *(s for pl in self.placed for s in pl.effect.needs)}
        outputs = dict.fromkeys(self.twin.outputs, wave)
        run = Run(t, 1e-2, dict.fromkeys(names, wave), self.twin.inputs, outputs, (0,), 0, {})
        theta = np.array([middle(f) for f in self._free])
        folded: set[int] = set()
        with np.errstate(all="ignore"):
            flow = self._courses(run, Pass(theta, False, folded))[0]
        found = {j for s in flow.values() for j in s.columns}
        return found - folded


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


def _frozen(settings: Settings) -> tuple[object, ...]:
    return tuple(sorted(settings.items()))
