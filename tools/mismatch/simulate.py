"""Simulates a twin with effects placed in its chain: parameters, views, design columns for exact solving."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sim_devices.physics.effect import Array, Human
from tools.mismatch.placed import Free, Placed, free_entry, middle
from tools.mismatch.recording import Recording
from tools.mismatch.simulate_chain import Chain, Pass, frozen
from tools.mismatch.simulate_view import View, view_run
from tools.mismatch.twins.base import Force, Run, Signal, Twin, fold
from tools.mismatch.twins.dynamic import DynamicTwin
from tools.mismatch.twins.memo import Nearby, remember, stored
from tools.mismatch.twins.ode import inside_of
from tools.mismatch.twins.ode_inside import PUSHED, weight_scale


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
        self.chain = Chain(twin, self.placed, tuple(self._slices))
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
            inside = inside_of(self.twin)
            if inside is not None and pl.site == "feedback":
                g = inside.force_gain(pl.target, theta[: self.n_base])[0]
            if inside is not None and pl.site == "input":
                g = inside.input_gain(pl.target, theta[: self.n_base])
            if pl.effect.report is not None:
                out[pl.label] = list(pl.effect.report(p, pl.settings, g))
            else:
                names = self.parameters[a.start : b.stop]
                out[pl.label] = [
                    Human(f.name.rsplit(".", 1)[-1], float(v), f.unit) for f, v in zip(names, p, strict=True)
                ]
        return out

    def base_text(self, theta: Array) -> dict[str, object]:
        """Return the twin's parameters for a twin file, with the initial rest position if no measurement shows it."""
        text = dict(self.twin.to_text(theta[: self.n_base]))
        if self.chain.bends and getattr(self.twin, "at_rest", False):
            text["x0"] = [0.0] * len(np.asarray(text["A"]))
        return text

    # -- simulation ---------------------------------------------------------------------------------

    def simulate(self, view: View, theta: Array, only: Collection[str] | None = None) -> dict[str, Array]:
        """Return the outputs on the view, (m,) each, of a free run that uses measured outputs for start states only.

        ``only`` restricts the outputs (None: all).
        """
        flow = self.chain.courses(view_run(self.twin, view), Pass(theta, True), only=only)[0]
        return {o: view.take(s.value) for o, s in flow.items()}

    def in_front(self, view: View, theta: Array) -> dict[str, Array]:
        """Return the outputs (n,) of a free run in front of the effects at outputs."""
        outputs = self.chain.courses(view_run(self.twin, view), Pass(theta, True))[1]
        return {o: view.take(fold(s, theta).value) for o, s in outputs.items()}

    def whole(self, view: View, theta: Array) -> dict[str, Array]:
        """Return the outputs over the whole recording (n,) from the start states that the view allows.

        They are cached, but for those of a search, which start near an earlier run.
        """

        def make() -> Array:
            flow = self.chain.courses(view_run(self.twin, view), Pass(theta, True))[0]
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
        flow = self.chain.courses(run, Pass(theta, False), only=only)[0]
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
        return tuple((*p.effect.form, p.site, p.target, p.outputs, frozen(p.settings)) for p in self.placed)

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
        return self.chain.courses(run, Pass(theta, join), inputs, forces)[0]

    def driven(self, run: Run, theta: Array) -> Run:
        """Return the run with its inputs as they are behind their effects."""
        inputs, _ = self.chain.driven(run, Pass(theta, True))
        gain = self.twin.input_gain
        behind = {s: fold(x, theta, gain(s, theta)).value for s, x in inputs.items() if s in run.signals}
        return replace(run, signals={**run.signals, **behind}, memo={})

    def start_states(self, view: View, theta: Array) -> Array:
        """Return the states (s,) at the first sample of a free run of differential equations."""
        inside = inside_of(self.twin)
        assert inside is not None
        run = view_run(self.twin, view)
        how = Pass(theta, True)
        inputs, forces = self.chain.driven(run, how)
        used = {s: fold(x, theta, inside.input_gain(s, theta)) for s, x in inputs.items()}
        _, run = self.chain.started(run, inputs, how, forces)
        return inside.states(run, used, theta, forces)[0][0]

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
            flow = self.chain.courses(run, Pass(theta, False, folded))[0]
        found = {j for s in flow.values() for j in s.columns}
        return found - folded
