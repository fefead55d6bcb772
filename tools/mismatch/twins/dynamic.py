"""Implements the common part of mechanical axes and state-space twins: response, columns, start states, forces."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sim_devices.physics.effect import Array, Human
from sim_devices.physics.forces import OFFSET, UNCENTRED
from tools.mismatch.twins.base import Balance, Counted, Force, Run, Signal, central_difference, midway, travelled
from tools.mismatch.twins.feedback import Body, Rows, pack
from tools.mismatch.twins.forced import ForcedRun
from tools.mismatch.twins.head import Head
from tools.mismatch.twins.holds import Holds
from tools.mismatch.twins.linear import (
    Discrete,
    Hold,
    StartState,
    between_samples,
    discretise,
    run_output,
    run_pair,
    run_states,
    start_state,
)
from tools.mismatch.twins.memo import remember

CONSTANT = ""  # the input "1"
MOST_SUBSTEPS = 24


@dataclass(frozen=True)
class Link:
    """Adds linear parameter ``j`` times state ``row`` of the companion driven by ``source`` to ``output``.

    ``row`` -1: the input itself; ``source`` "" with row -2: a constant offset of the output.
    """

    j: int
    output: str
    source: str
    row: int


@dataclass(frozen=True)
class Plant:
    """Holds a continuous (or discrete) ``x' = a x + b w`` at given nonlinear parameters.

    ``blocks``: first row and last row + 1 of each block of a block-diagonal ``a``; empty if ``a`` is one block.
    Blocks run separately: an unchanged one is not run again.
    """

    a: Array
    b: Array
    blocks: tuple[tuple[int, int], ...] = ()

    @property
    def parts(self) -> tuple[tuple[int, int], ...]:
        """Return the blocks; a single one if none are named."""
        return self.blocks or ((0, self.a.shape[0]),)


@dataclass(frozen=True)
class DynamicTwin(Head):
    """Implements a dynamic twin; ``plant_of(theta)`` builds the plant from the nonlinear base parameters.

    ``groups``: outputs that share one state, with their state rows (one of each block). ``fixed_free(n)`` is the
    response to the engineer's own start state, used when no sample may set it; ``start_given``: the engineer gave one.
    """

    holds: Holds
    links: tuple[Link, ...]
    groups: tuple[Mapping[str, int | tuple[int, ...]], ...]
    begin: Array
    plant_of: Callable[[Array], Plant]
    fixed_free: Callable[[int], Mapping[str, Array]] | None
    human_of: Callable[[Array], Sequence[Human]]
    text_of: Callable[[Array], dict[str, object]]
    restart: bool
    feedback_on: str
    fastest_per_s: float
    static: bool = False
    apart: bool = False
    counted: Counted = ""
    start_given: bool = False
    at_rest: bool = False
    """True if the given start state is zero."""
    motion_of: Callable[[Array, Array, Array], Array] | None = None
    """(position, velocity, input), each (n,) -> the slopes (n, k) of the acceleration, which is linear in the base
    parameters; None if it is not."""

    def start(self, recording: object) -> Array:
        """See Twin."""
        return self.begin.copy()

    def drive(self, output: str) -> str:
        """See Twin."""
        return self.inputs[0] if len(self.inputs) == 1 else ""

    def facts(self, output: str) -> Mapping[str, tuple[float, ...]]:
        """See Twin."""
        uncentred = {UNCENTRED: (1.0,)} if self.counted == "start" else {}
        return {**uncentred, **({OFFSET: (1.0,)} if self._has_offset else {})}

    @property
    def _has_offset(self) -> bool:
        """Return True if a constant force is a parameter of the twin, or moves the zeros of its outputs alone."""
        if self.kind == "mechanical_axis":
            return True
        size = np.abs(np.linalg.eigvals(self.plant_of(self.begin).a))
        discrete = self.holds.get(self.inputs[0]) == "discrete"
        return not discrete and bool(np.min(size, initial=np.inf) > 1e-9 * np.max(size, initial=0.0))

    def sensitivity(self, output: str, theta: Array) -> float:
        """See Twin: this is the gain that weights of input and feedback effects carry."""
        return self.input_gain(self.inputs[0], theta)

    def input_gain(self, signal: str, theta: Array) -> float:
        """See Twin."""
        j = self._gain_index(signal)
        return float(theta[j]) if j >= 0 else 1.0

    def human(self, theta: Array) -> Sequence[Human]:
        """See Twin."""
        return self.human_of(theta)

    def to_text(self, theta: Array) -> dict[str, object]:
        """See Twin."""
        return self.text_of(theta)

    def balance(self, run: Run, theta: Array, target: str) -> Balance | None:
        """Return both sides of the equation of motion along the recording; None where a state was not recorded."""
        if self.motion_of is None:
            return None
        v = run.measured.get("velocity")
        x = run.measured["position"] if v is None else run.measured.get("position")
        order = 2 if v is None else 1
        reading = x if v is None else v
        assert reading is not None
        v = central_difference(reading, run.dt, 1) if v is None else v
        x = travelled(v, run.dt, self.counted or "start") if x is None else x
        drive, motion, position, velocity = self.inputs[0], self.motion_of, x, v

        def slopes(signals: Mapping[str, Array]) -> Array:
            return motion(position, velocity, midway(signals[drive], self.holds[drive] == "zero"))

        def at(theta: Array, signals: Mapping[str, Array]) -> Array:
            columns = slopes(signals)
            return columns @ theta[: columns.shape[1]]

        rate = central_difference(reading, run.dt, order)
        return Balance(reading, order, rate, at(theta, run.signals), slopes(run.signals), at)

    def _gain_index(self, signal: str) -> int:
        js = {link.j for link in self.links if link.source == signal}
        return js.pop() if len(js) == 1 else -1

    # -- response -----------------------------------------------------------------------------------

    def respond(
        self, run: Run, inputs: Mapping[str, Signal], theta: Array, forces: Sequence[Force], join: bool
    ) -> dict[str, Signal]:
        """See Twin."""
        n = run.t.size
        plant = self.plant_of(theta)
        # one state and one input: a single run from the right start state does, without columns
        alone = join and len(self.inputs) == 1 and len(self.groups) == 1 and len(plant.blocks) < 2
        alone = alone and not run.paths and not run.beside
        if forces or (alone and run.setting is None and (self.start_given or not run.period)):
            return self._with_forces(run, inputs, theta, forces)
        by_hold: dict[Hold, list[Discrete]] = {
            h: discretise_blocks(plant, run.dt, h) for h in dict.fromkeys(self.holds.values())
        }
        d = next(iter(by_hold.values()))
        where = {r: (k, r - a) for k, (a, b) in enumerate(plant.parts) for r in range(a, b)}
        tags = {
            h: [(b.ad.tobytes(), b.g0.tobytes(), b.g1.tobytes(), run.starts) for b in of] for h, of in by_hold.items()
        }
        value: dict[str, Array] = {o: np.zeros(n) for o in self.outputs}
        columns: dict[int, dict[str, Array]] = {j: {} for of in run.beside.values() for j in of}
        folded: list[float] = []

        def states(u: Array, token: object, k: int, hold: Hold) -> Array:
            key = ("states", token, tags[hold][k])
            return remember(run.memo, key, lambda: _states(by_hold[hold][k], between_samples(u, hold), run.starts))

        def add(j: int, output: str, column: Array) -> None:
            if join:
                value[output] = value[output] + theta[j] * column
            else:
                entry = columns.setdefault(j, {})
                entry[output] = entry[output] + column if output in entry else column

        one = np.ones(n)
        for source in {link.source: None for link in self.links}:
            links = [link for link in self.links if link.source == source]
            drive = Signal(one, {}, (CONSTANT,)) if source == CONSTANT else inputs[source]
            normal = self._gain_index(source) >= 0
            hold = self.holds[source] if source else next(iter(by_hold))  # a constant is the same for each
            parts: list[tuple[int, Array, object]] = [(-1, drive.value, drive.token)]
            if drive.columns and normal:
                if join:
                    g = self.input_gain(source, theta)
                    total = drive.value + sum(theta[j] / g * c for j, c in drive.columns.items())
                    keys = tuple(theta[j] / g for j in drive.columns)
                    folded += keys
                    parts = [(-1, np.asarray(total), (*drive.token, keys))]
                else:
                    parts += [(j, c, (*drive.token, j)) for j, c in drive.columns.items()]
            elif drive.columns:
                total = drive.value + sum(theta[j] * c for j, c in drive.columns.items())
                keys = tuple(theta[j] for j in drive.columns)
                folded += keys
                parts = [(-1, np.asarray(total), (*drive.token, keys))]
            for j, u, token in parts:
                needed = sorted({where[link.row][0] for link in links if link.row >= 0})
                x = {k: states(u, token, k, hold) for k in needed}
                for link in links:
                    if link.row < 0:
                        column = u
                    else:
                        k, r = where[link.row]
                        column = x[k][:, r]
                    add(link.j if j < 0 else j, link.output, column)
        token = ("plant", *map(tuple, tags.values()), run.window, run.bent, run.beside_token)
        token = (*token, *((o, p.token) for o, p in run.paths.items()))
        token = (*token, *(x.token for x in inputs.values()), tuple(folded))
        if join:
            token = (*token, theta[: len(self.parameters)].tobytes())
        return self._settle(run, _whole(d, plant), plant.blocks, value, columns, token)

    def through(self, run: Run, signal: str, theta: Array, output: str) -> Callable[[Array], Array]:
        """See Twin."""
        source = signal or self.inputs[0]
        hold = self.holds[source]
        plant = self.plant_of(theta)
        d = discretise_blocks(plant, run.dt, hold)
        normal = self._gain_index(source) >= 0
        group = next((g for g in self.groups if output in g), None)
        outputs = tuple(group or (output,))
        links = [link for link in self.links if link.source == source and (link.output == output or normal)]
        ss = self._start_state(run, _whole(d, plant), plant.blocks, group) if group is not None else None
        rows = {o: np.zeros(plant.a.shape[0]) for o in outputs}
        direct = dict.fromkeys(outputs, 0.0)
        for link in links:
            if link.output in rows:
                gain = 1.0 if normal and not signal else float(theta[link.j])
                if link.row >= 0:
                    rows[link.output][link.row] += gain
                else:
                    direct[link.output] += gain
        at = np.array(run.starts, np.int64)

        def carry(change: Array) -> Array:
            u = _once(change)
            y = {o: direct[o] * u for o in outputs}
            u = _once(between_samples(u, hold))
            for o in outputs:
                for part, (a, b) in zip(d, plant.parts, strict=True):
                    c = rows[o][a:b]
                    if not np.any(c):
                        continue
                    if b - a == 2:
                        y[o] += run_pair(part.ad, part.g0, part.g1, c, u, at)
                    else:
                        y[o] += run_output(part.ad, part.g0, part.g1, c, u, at)
            if ss is not None:
                x0 = ss.steady(y, run.period) if run.period else ss.states({o: -v for o, v in y.items()})
                y[output] += ss.response(x0, output, change.size)
            return y[output]

        return carry

    def _settle(
        self,
        run: Run,
        ad: Array,
        blocks: tuple[tuple[int, int], ...],
        value: dict[str, Array],
        columns: dict[int, dict[str, Array]],
        token: tuple[object, ...],
    ) -> dict[str, Signal]:
        """Add the free response of the start states: the engineer's, or those that the first samples determine."""
        n = run.t.size
        zero = np.zeros(n)
        given = self.start_given or (run.window == 0 and not run.period)
        read = run.setting is not None and not (run.bent and self.at_rest)
        if given and not read and self.fixed_free is not None and run.starts == (0,):
            for o, y in self.fixed_free(n).items():
                value[o] = value[o] + y
        else:
            for group in self.groups:
                # a value and its columns are settled alike: the start state is an affine function of them
                ss = self._start_state(run, ad, blocks, group)
                group_values = {o: value[o] for o in group}
                x0 = ss.steady(group_values, run.period) if run.period else ss.met(group_values, run.measured)
                if run.wanted is not None:
                    self._settle_at(run, ss, x0, value, columns)
                    continue
                for o in group:
                    value[o] = ss.added(value[o].copy(), x0, o)
                for j, entry in columns.items():
                    added = {o: run.beside.get(o, {}).get(j) for o in group}
                    if not any(o in entry or added[o] is not None for o in group):
                        continue
                    group_values = {o: entry.get(o, zero) for o in group}
                    wanted = {o: zero if c is None else -c for o, c in added.items()}
                    x0 = ss.steady(group_values, run.period) if run.period else ss.met(group_values, wanted)
                    for o in group:
                        # a copy, because the column may be cached
                        entry[o] = ss.added(np.array(entry.get(o, zero), np.float64), x0, o)
        return {o: Signal(value[o], {j: e[o] for j, e in columns.items() if o in e}, (*token, o)) for o in self.outputs}

    def _settle_at(
        self, run: Run, ss: StartState, x0: Array, value: dict[str, Array], columns: dict[int, dict[str, Array]]
    ) -> None:
        """Settle a value and all columns of a group of outputs at once, at the wanted samples of a run only."""
        wanted, period = run.wanted, run.period
        assert wanted is not None
        entries = [e for e in columns.values() if any(o in e for o in ss.outputs)]
        zero = np.zeros(run.t.size)
        given = {o: [e.get(o, zero) for e in entries] for o in ss.outputs}
        if period:
            alone = [{o: given[o][i] for o in ss.outputs} for i in range(len(entries))]
            states = np.stack([x0, *(ss.steady(y, period) for y in alone)], axis=2)
        else:
            states = np.concatenate([x0[:, :, None], -ss.states_of(given)], axis=2) if entries else x0[:, :, None]
        for o in ss.outputs:
            free = [f @ x for f, x in zip(ss.at(wanted, o), states, strict=True)]
            found = np.stack([value[o][wanted], *(c[wanted] for c in given[o])], axis=1) + np.concatenate(free)
            value[o] = found[:, 0]
            for i, entry in enumerate(entries):
                entry[o] = found[:, i + 1]

    def _start_state(
        self, run: Run, ad: Array, blocks: tuple[tuple[int, int], ...], group: Mapping[str, int | tuple[int, ...]]
    ) -> StartState:
        rows: dict[str, Array] = {}
        for o, r in group.items():
            c = np.zeros(ad.shape[0])
            c[list(r) if isinstance(r, tuple) else r] = 1.0
            rows[o] = c
        return start_state(ad, rows, run, blocks=blocks)

    def _substeps(self, run: Run, packed: Rows, push: float) -> int:
        """Return the steps per sample, a power of two so that it seldom changes during a fit.

        There are four steps per radian of the fastest mode, two per radian of the stiffest memory and eight per period
        of cogging. ``push`` is the acceleration per unit of force.
        """
        sub = int(np.ceil(run.dt * (packed.fastest_per_s or self.fastest_per_s) / 0.25))
        springs = float(np.sum(np.abs(packed.memory))) + max(float(packed.friction[5]), 0.0)
        stiff = run.dt * np.sqrt(abs(push) * springs) / 0.5
        if stiff > sub:
            sub = 1 << int(np.ceil(np.log2(min(stiff, MOST_SUBSTEPS))))
        if packed.cogging[0] > 0:
            course = run.measured[self.feedback_on]
            travel = float(np.quantile(np.abs(np.diff(course)), 0.99))
            if self.feedback_on == "velocity":
                travel = float(np.quantile(np.abs(course), 0.99)) * run.dt
            sub = max(sub, int(np.ceil(8 * travel / packed.cogging[0])))
        return int(np.clip(sub, 1, MOST_SUBSTEPS))

    def _with_forces(
        self, run: Run, inputs: Mapping[str, Signal], theta: Array, forces: Sequence[Force]
    ) -> dict[str, Signal]:
        """Simulate one input's response in free run, without columns, and with forces inside the plant if any are."""
        plant, drive = self.plant_of(theta), inputs[self.inputs[0]]
        u, rows, extra = self._driven(drive, theta, np.zeros(plant.a.shape[0]))
        packed = pack(forces)
        body = self._body(run, plant, rows, packed, bool(forces))
        forced = ForcedRun(run, body, packed if forces else None, u, rows, extra, plant.blocks)
        token: tuple[object, ...] = ("forced", theta[: len(self.parameters)].tobytes(), run.starts, run.window)
        token = (*token, drive.token, tuple(theta[j] for j in drive.columns))
        token = (*token, *((f.effect.form, _key(f)) for f in forces))
        return {o: Signal(y, {}, (*token, o)) for o, y in self._from_start(forced).items()}

    def _from_start(self, forced: ForcedRun) -> dict[str, Array]:
        """Return every output (n,), from the start state that is given, or that the measured samples set."""
        run = forced.run
        given = self.start_given or (run.window == 0 and not run.period)
        if given and self.fixed_free is not None and run.starts == (0,):
            # with forces, the start state is no linear function of the measurement: the engineer's own is used,
            # unless the twin without forces starts from a fitted one as well
            if forced.forces is not None and run.setting is not None and not self.at_rest:
                return forced.outputs(forced.begin_by_setting())
            free = self.fixed_free(run.t.size)
            return {o: y + free[o] for o, y in forced.outputs(np.zeros((1, forced.order))).items()}
        x0 = np.zeros((forced.starts.size, forced.order))
        if forced.forces is not None and self.counted:
            # the rows of the outputs do not show where it stands; how it came there was recorded
            x0[:, 0] = travelled(run.measured[self.feedback_on], run.dt, self.counted)[forced.starts]
        if run.period and (begin := forced.begin_by_period(x0)) is not None:
            return forced.outputs(begin)
        return forced.outputs(forced.begin_by_windows(x0))

    def _driven(self, drive: Signal, theta: Array, no_row: Array) -> tuple[Array, dict[str, Array], dict[str, Array]]:
        """Return the plant's input (n,), the row (s,) of each output, and what is added to each output (n,)."""
        source = self.inputs[0]
        g = self.input_gain(source, theta)
        has_gain = self._gain_index(source) >= 0
        direct = g * drive.value
        for j, c in drive.columns.items():
            direct = direct + (1.0 if has_gain else g) * theta[j] * c
        rows = {o: no_row.copy() for o in self.outputs}
        extra = {o: np.zeros(direct.size) for o in self.outputs}
        u = between_samples(direct, self.holds[source])
        for j in {link.j for link in self.links if link.source == CONSTANT and link.row != -2}:
            u = u + theta[j]
        for link in self.links:
            if link.row == -2:
                extra[link.output] = extra[link.output] + theta[link.j]
            elif link.source == CONSTANT:
                continue
            elif link.row == -1:
                extra[link.output] = extra[link.output] + theta[link.j] * direct
            else:
                rows[link.output][link.row] = 1.0 if has_gain else theta[link.j]
        return _once(u), rows, extra

    def _body(self, run: Run, plant: Plant, rows: Mapping[str, Array], packed: Rows, has_forces: bool) -> Body:
        """Return the discretised plant with the rows of the position and velocity on which forces depend.

        Bristles of ``packed`` that are too stiff for the finest step become rigid, in place.
        """
        cp = np.eye(plant.a.shape[0])[0] if self.counted else rows.get(self.feedback_on, np.zeros(plant.a.shape[0]))
        sub, hold = 1, self.holds[self.inputs[0]]
        if has_forces and hold != "discrete":
            push = float(cp @ plant.a @ plant.b) or 1.0
            packed.friction[5] = min(packed.friction[5], (0.7 * MOST_SUBSTEPS / run.dt) ** 2 / abs(push))
            sub = self._substeps(run, packed, push)
        d = discretise(plant.a, plant.b, run.dt / sub, hold)
        if self.counted or ("velocity" in self.outputs and self.feedback_on == "position"):
            cv = rows["velocity"]
        elif hold == "discrete":
            cv = cp @ (plant.a - np.eye(plant.a.shape[0])) / run.dt
        else:
            cv = cp @ plant.a if abs(cp @ plant.b) < 1e-12 * (np.abs(cp) @ np.abs(plant.b) + 1e-300) else cp
        held = hold in ("zero", "discrete")
        dry = bool(np.any(packed.friction[:3] != 0.0)) and float(cv @ (d.g0 + d.g1)) > 0.0 and packed.friction[5] <= 0.0
        return Body(d.ad, d.g0, d.g1, cp, cv, held, sub, run.dt / sub, dry)


def discretise_blocks(plant: Plant, dt: float, hold: Hold) -> list[Discrete]:
    """Return the difference equation of every block."""
    return [discretise(np.ascontiguousarray(plant.a[a:b, a:b]), plant.b[a:b], dt, hold) for a, b in plant.parts]


def _whole(d: Sequence[Discrete], plant: Plant) -> Array:
    """Return the transition matrix (s, s) of all blocks."""
    if len(d) == 1:
        return d[0].ad
    ad = np.zeros(plant.a.shape)
    for part, (a, b) in zip(d, plant.parts, strict=True):
        ad[a:b, a:b] = part.ad
    return ad


def _states(d: Discrete, u: Array, starts: tuple[int, ...]) -> Array:
    s = d.ad.shape[0]
    at = np.array(starts, np.int64)
    return run_states(d.ad, d.g0, d.g1, _once(u), np.zeros((at.size, s)), at)


def _key(force: Force) -> tuple[object, ...]:
    return force.q.tobytes(), force.weights.tobytes(), tuple(sorted(force.settings.items()))


def _once(u: Array) -> Array:
    return np.ascontiguousarray(u, np.float64)
