"""Uses differential equations as a twin; forces and flows can be added to the derivative of each named state."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sim_devices.physics.effect import Array, Human
from sim_devices.physics.forces import OFFSET, UNCENTRED
from tools.errors import RecordingError
from tools.mismatch.recording import Recording
from tools.mismatch.twins.affine import Steps, exact_steps, run_pushed
from tools.mismatch.twins.base import Balance, Counted, Force, Run, Signal, central_difference, fold, midway
from tools.mismatch.twins.equations import Equations, Linearised, State, linearise
from tools.mismatch.twins.forced import shot_to_repeat
from tools.mismatch.twins.head import Head
from tools.mismatch.twins.holds import Holds
from tools.mismatch.twins.linear import discretise, run_output, start_state
from tools.mismatch.twins.memo import Start, remember, stored
from tools.mismatch.twins.ode_inside import NOTHING, PUSHED, VARYING, Inside, Place, pack_inside, substeps_of, sway_of
from tools.mismatch.twins.ode_run import Drive
from tools.mismatch.twins.ode_start import StartSearch
from tools.mismatch.twins.vocabulary import NO_STATE

FORGOTTEN = 20.0  # least number of time constants in a record; a slower state is set in every stretch


@dataclass(frozen=True)
class OdeTwin(Head):
    """Simulates differential equations.

    ``signals``: inputs of the equations, then context. ``given``: the engineer's numbers by name, and the offset of
    every output; ``names``: these in the order of the equations, ``free``: the indices of those that may be re-fitted.
    """

    equations: Equations
    state_list: tuple[State, ...]
    signals: tuple[str, ...]
    names: tuple[str, ...]
    free: tuple[int, ...]
    given: Mapping[str, float]
    holds: Holds
    text_of: Callable[[Mapping[str, float]], dict[str, object]] = field(repr=False)
    parameter_units: Mapping[str, str]
    typical: Array
    """Size of each state in a run as given, (s,)."""
    middle: tuple[Array, Array]
    """Mean states (s,) and signals (m,) of a run as given."""
    places: tuple[Place, ...]
    fastest_per_s: float
    restart: bool
    integrates: bool
    """True if the response to a start state does not decay within the recording."""
    feedback_on: str
    static: bool = False
    apart: bool = False
    counted: Counted = ""

    @cached_property
    def held(self) -> NDArray[np.bool_]:
        """Return True for each of ``signals`` (m,) that is held between its samples; the others run straight."""
        return np.array([self.holds.get(s) == "zero" for s in self.signals])

    def start(self, recording: Recording) -> Array:
        """See Twin."""
        return np.array([self.given[self.names[i]] for i in self.free])

    def values(self, theta: Array) -> Array:
        """Return the numbers of the equations for base parameters ``theta`` (further entries are ignored)."""
        out = np.array([self.given[n] for n in self.names])
        out[list(self.free)] = theta[: len(self.free)]
        return out

    def drive(self, output: str) -> str:
        """See Twin."""
        return self.inputs[0] if len(self.inputs) == 1 else ""

    def facts(self, output: str) -> Mapping[str, tuple[float, ...]]:
        """See Twin."""
        if self._is_free:
            return {UNCENTRED: (1.0,)}
        free = {self.names[i] for i in self.free}
        return {OFFSET: (1.0,)} if self.equations.affine and {f"{o}_offset" for o in self.outputs} <= free else {}

    @cached_property
    def _is_free(self) -> bool:
        """Return True if nothing holds a position of the equations as given."""
        a = self.linearised(self.start_values).a
        return any(p.kind == "motion" and a[p.target, p.position] == 0.0 for p in self.places)

    @cached_property
    def start_values(self) -> Array:
        """Return the engineer's own numbers."""
        return np.array([self.given[n] for n in self.names])

    def sensitivity(self, output: str, theta: Array) -> float:
        """See Twin: what effects at an input carry is in input units."""
        return 1.0

    def input_gain(self, signal: str, theta: Array) -> float:
        """See Twin: where outputs are sums of the inputs, that of the output which follows the signal most."""
        if not self.sums_inputs or signal not in self.signals:
            return 1.0
        gains = self._gains(theta)[:, self.signals.index(signal)]
        return float(gains[np.argmax(np.abs(gains))]) or 1.0

    def human(self, theta: Array) -> Sequence[Human]:
        """See Twin."""
        return [
            Human(self.names[i], float(v), self.parameter_units.get(self.names[i], ""))
            for i, v in zip(self.free, theta, strict=False)
        ]

    def to_text(self, theta: Array) -> dict[str, object]:
        """See Twin."""
        return self.text_of({self.names[i]: float(v) for i, v in zip(self.free, theta, strict=False)})

    # -- places ---------------------------------------------------------------------------------------

    def place(self, name: str) -> Place:
        """Return the place of that name. Raises RecordingError for an unknown one, which a twin file may name."""
        for p in self.places:
            if p.name == name:
                return p
        known = ", ".join(p.name for p in self.places) or "none"
        raise RecordingError(f"no state '{name}' that a force or flow can act on; there are: {known}")

    def force_gain(self, target: str, theta: Array) -> tuple[float, str]:
        """Return the gain from the input that drives a place to the derivative there, and that input ("": none)."""
        if self.place(target).kind in VARYING:
            return 1.0, ""
        row = self.linearised(self.values(theta)).b[self.place(target).target]
        for i, s in enumerate(self.inputs):
            if row[i] != 0.0:
                return float(row[i]), s
        return 1.0, ""

    def place_units(self, target: str) -> tuple[str, str]:
        """Return the units of a force at a place (that of the input that drives it, if any) and of its position."""
        place = self.place(target)
        _, source = self.force_gain(target, self.start_values[list(self.free)])
        per = "s^2" if place.kind in PUSHED else "s"
        return (self.units[source] if source else f"{place.unit}/{per}"), place.unit

    def force_scale(self, target: str) -> tuple[float, float, float]:
        """Return typical derivative, position and velocity at a place, which scale the weights."""
        place = self.place(target)
        size, speed = self.typical[place.position], self.typical[place.velocity]
        if place.kind == "joint":
            size, speed = place.pairs[4:]
        if place.kind == "storage":
            speed = size * self.fastest_per_s
            return speed, size, speed
        return speed * max(self.fastest_per_s, speed / size), size, speed

    def course(self, run: Run, theta: Array, target: str) -> tuple[Array, Array]:
        """Return position and velocity (n,) at a place: as recorded if an output reads them, else as simulated."""
        place = self.place(target)
        if place.kind == "parameter":
            signal = run.signals[self.signals[place.position]]
            return signal, np.gradient(signal, run.dt)
        if place.kind in ("state", "direction"):
            ((x, _),) = self._courses(run, theta, (place.position,))
            return x, np.gradient(x, run.dt)
        if place.kind == "joint":
            other, speed, _, ratio = place.pairs[:4]
            sides = (place.position, place.velocity, int(other), int(speed))
            (x, _), (v, _), (x_2, _), (v_2, _) = self._courses(run, theta, sides)
            return x - ratio * x_2, v - ratio * v_2
        (position, _), (velocity, _) = self._courses(run, theta, (place.position, place.velocity))
        return position, velocity

    def storage_ranges(self, run: Run, theta: Array, target: str, mask: NDArray[np.bool_]) -> tuple[float, ...]:
        """Return the ranges (``flows.RANGES``) of every storage of a place where ``mask`` (n,) is set."""
        stores = dict.fromkeys(int(v) for v in self.place(target).pairs[::2])
        found: list[float] = []
        for x, recorded in self._courses(run, theta, tuple(stores)):
            low, high = float(np.min(x[mask])), float(np.max(x[mask]))
            rate = float(np.sqrt(np.mean(np.gradient(x, run.dt)[mask] ** 2)))
            found += [low, high, rate, high if recorded else high + 0.5 * (high - low)]
        return tuple(found)

    def _courses(self, run: Run, theta: Array, states: Sequence[int]) -> list[tuple[Array, bool]]:
        """Return the courses (n,) of states, and if an output reads them: then as recorded, else as simulated.

        An output reads a state if nothing but a factor and a zero is between them.
        """
        x = self._simulated(run, {s: run.signals[s] for s in self.signals}, theta, ())
        c = self.linearised(self.values(theta)).c
        found: list[tuple[Array, bool]] = []
        for i in states:
            y, recorded = x[:, i], False
            for k, o in enumerate(self.outputs):
                alone = c[k, i] != 0.0 and np.count_nonzero(c[k]) == 1
                beside = self.readings(x, run, theta)[:, k] - c[k, i] * y if alone else y
                zero = float(beside[0])
                if alone and np.allclose(beside, zero, rtol=0.0, atol=1e-12 + 1e-9 * float(np.max(np.abs(x[:, i])))):
                    y, recorded = (run.measured[o] - zero) / c[k, i], True
                    break
            found.append((np.ascontiguousarray(y), recorded))
        return found

    def balance(self, run: Run, theta: Array, target: str) -> Balance | None:
        """Return both sides of the equation of motion at a place along the recording.

        None where a state was not recorded, be it as the derivative of a position.
        """
        place = self.place(target)
        if place.kind != "motion":
            return None
        found = self._courses(run, theta, range(len(self.state_list)))
        x = np.column_stack([y for y, _ in found])
        recorded = [read for _, read in found]
        order = 1 if recorded[place.velocity] else 2
        for p in self.places:
            if p.kind == "motion" and recorded[p.position] and not recorded[p.velocity]:
                x[:, p.velocity], recorded[p.velocity] = central_difference(x[:, p.position], run.dt, 1), True
        if not all(recorded) or place.target != place.velocity:
            return None
        reading = np.ascontiguousarray(x[:, place.velocity if order == 1 else place.position])

        def at(theta: Array, signals: Mapping[str, Array]) -> Array:
            u = np.column_stack([midway(signals[s], h) for s, h in zip(self.signals, self.held.tolist(), strict=True)])
            return self.equations.rates_along(x, u, run.t, self.values(theta))[:, place.target]

        model, slopes = at(theta, run.signals), list[Array]()
        for i in range(len(self.free)):
            moved = theta.copy()
            moved[i] += 1e-4 * (abs(theta[i]) or abs(self.parameters[i].scale) or 1.0)
            slopes.append((at(moved, run.signals) - model) / (moved[i] - theta[i]))
        rate = central_difference(reading, run.dt, order)
        return Balance(reading, order, rate, model, np.column_stack(slopes), at)

    # -- simulation -----------------------------------------------------------------------------------

    def respond(
        self, run: Run, inputs: Mapping[str, Signal], theta: Array, forces: Sequence[Force], join: bool
    ) -> dict[str, Signal]:
        """See Twin. Nothing stays linear behind equations, but for outputs that are sums of their inputs at once."""
        if not join and not forces and self.sums_inputs:
            return self._sums(run, inputs, theta)
        used = {s: fold(x, theta, self.input_gain(s, theta)) for s, x in inputs.items()}
        key: tuple[object, ...] = ("ode", theta[: len(self.free)].tobytes(), run.starts, run.window, run.nearby)
        key = (*key, *(x.token for x in used.values()), *((o, p.token) for o, p in run.paths.items()))
        key = (*key, *((f.effect.form, f.target, f.q.tobytes(), f.weights.tobytes(), _settings(f)) for f in forces))

        def make() -> Array:
            x, u = self.states(run, used, theta, forces)
            readings = self.equations.readings(x, u, run.t, self.values(theta), sway_of(forces, self.place))
            return np.ascontiguousarray(readings.T)

        with np.errstate(all="ignore"):
            stacked = remember(run.memo, key, make)
        return {o: Signal(stacked[i], {}, (key, o)) for i, o in enumerate(self.outputs)}

    @cached_property
    def has_states(self) -> bool:
        """Return False for a curve."""
        return [x.name for x in self.state_list] != [NO_STATE]

    @cached_property
    def sums_inputs(self) -> bool:
        """Return True if no state moves and the outputs are affine in the signals."""
        return self.reads_affine and not self.has_states

    def _gains(self, theta: Array) -> Array:
        """Return the gains (q, m) from the signals to outputs that are their sums."""
        m = len(self.signals)
        units = np.ascontiguousarray(np.vstack([np.zeros(m), np.eye(m)]))
        y = self.equations.readings(np.zeros((m + 1, 1)), units, np.zeros(m + 1), self.values(theta))
        return (y[1:] - y[0]).T

    def _sums(self, run: Run, inputs: Mapping[str, Signal], theta: Array) -> dict[str, Signal]:
        """Return outputs that are sums of the inputs and of their columns."""
        plain = {s: Signal(x.value, {}, x.token) for s, x in inputs.items()}
        gains, found = self._gains(theta), dict[str, Signal]()
        for i, (o, signal) in enumerate(self.respond(run, plain, theta, (), True).items()):
            columns: dict[int, Array] = {}
            for s, x in inputs.items():
                gain = float(gains[i, self.signals.index(s)]) / self.input_gain(s, theta)
                for j, c in x.columns.items():
                    columns[j] = columns[j] + gain * c if j in columns else gain * c
            found[o] = replace(signal, columns=columns)
        return found

    def states(
        self, run: Run, inputs: Mapping[str, Signal], theta: Array, forces: Sequence[Force]
    ) -> tuple[Array, Array]:
        """Return states (n, s) of a free run and the signals (n, m) of the equations; ``inputs`` have no columns."""
        # the synthetic stretch that tests which parameters are linear has no context
        none = np.zeros(run.t.size)
        signals = {s: inputs[s].value if s in inputs else run.signals.get(s, none) for s in self.signals}
        return self._simulated(run, signals, theta, forces), np.column_stack([signals[s] for s in self.signals])

    def readings(self, x: Array, run: Run, theta: Array) -> Array:
        """Return outputs (n, q) for states (n, s) of a run."""
        u = np.column_stack([run.signals[s] for s in self.signals])
        return self.equations.readings(x, u, run.t, self.values(theta))

    def reaction(self, place: Place, values: Array) -> float:
        """Return the change of the second derivative of a joint per change of the first: the inertias are the twin's.

        The spring of the joint pulls both sides: its two slopes are as the inverse inertias.
        """
        a = self.linearised(values).a
        other, _, target, ratio = place.pairs[:4]
        return -ratio * float(a[int(target), place.position] / a[place.target, int(other)])

    def packed(self, forces: Sequence[Force], values: Array) -> Inside:
        """Return forces and flows, packed for the compiled loop; ``values``: the parameters of the equations."""
        return pack_inside(forces, self.place, lambda place: self.reaction(place, values))

    def substeps(self, dt: float, inside: Inside) -> tuple[int, int]:
        """Return the steps per sample and the parts of a step (``ode_inside.substeps_of``)."""
        return substeps_of(dt, inside, self.fastest_per_s, self.typical)

    def _simulated(self, run: Run, signals: Mapping[str, Array], theta: Array, forces: Sequence[Force]) -> Array:
        """Return states (n, s) of a free run from start states that the measured samples of each stretch set."""
        if not self.has_states:
            return np.zeros((run.t.size, 1))
        values = self.values(theta)
        inside = self.packed(forces, values)
        sub, fine = self.substeps(run.dt, inside)
        u = np.ascontiguousarray(np.column_stack([signals[s] for s in self.signals]))
        limits = (np.array([s.lowest for s in self.state_list]), np.array([s.highest for s in self.state_list]))
        starts, ends = _stretches_of(run)
        steps = self._steps(run, values) if self.has_exact_steps and not forces else None
        if steps is not None and not np.all(np.isfinite(steps.ad)):
            # a trial of the search at which the equations grow beyond all numbers within a step
            return np.full((run.t.size, len(self.state_list)), np.nan)

        def go(x0: Array, first: NDArray[np.int64], stop: NDArray[np.int64], u: Array, t: Array) -> Array:
            if steps is not None:
                return steps.run(x0, u, first, stop)
            drive = Drive(u, self.held, t, run.dt, sub, fine, first, stop)
            return self.equations.states(x0, drive, values, inside, limits)

        given = np.array([[x.start for x in self.state_list]])
        if run.window == 0 and run.starts == (0,) and (np.any(given) or not run.period):
            return go(given, starts, ends, u, run.t)
        if run.period:
            ad = discretise(self.linearised(values).a, np.zeros(given.shape[1]), run.dt, "zero").ad

            def once(x0: Array, part: Array, first: NDArray[np.int64], stop: NDArray[np.int64]) -> Array:
                times = np.concatenate([run.t[a : a + run.period + 1] for a in starts])
                return go(x0, first, stop, part, times)

            full = np.linalg.matrix_power(ad, run.period)
            begin = shot_to_repeat(once, full, np.repeat(given, starts.size, axis=0), u, starts, run.period)
            if begin is not None:
                return go(begin, starts, ends, u, run.t)

        def plain() -> Array:
            # a run of the engineer's own model from its own start gives first guesses for later stretches
            end = np.array([run.t.size], np.int64)
            drive = Drive(u, self.held, run.t, run.dt, *self.substeps(run.dt, NOTHING), starts[:1], end)
            return self.equations.states(given, drive, self.start_values, NOTHING, limits)[starts]

        x0 = remember(run.lasting, ("about", run.starts), plain)
        x0 = np.where(np.isfinite(x0), x0, given)
        reading = self._reading(run, values)
        if not np.all(np.isfinite(reading)):
            # a trial at which the outputs have no value, a root of a negative number
            return np.full((run.t.size, len(self.state_list)), np.nan)
        if steps is not None and self.reads_affine and all(p.is_linear for p in run.paths.values()):
            return self._run_affine(run, steps, x0, u, values)

        def read(x: Array, u: Array, t: Array) -> Array:
            return self.equations.readings(x, u, t, values, inside.sway)

        seen, whole = self._setting(run)
        weight = self._weights(run)
        search = StartSearch(run, u, starts, ends, seen, whole, self.outputs, weight, self.typical, limits, go, read)
        for found in (search.from_nearest, search.from_earlier):
            if (x := found()) is not None:
                return x
        return search.anew(x0, reading)

    def _steps(self, run: Run, values: Array) -> Steps:
        """Return the exact steps for these numbers, which runs of one recording share."""
        key = ("steps", values.tobytes())
        steps = run.lasting.get(key)
        if not isinstance(steps, Steps):
            steps = self.exact_steps(run.dt, values)
            stored(run.lasting, key, steps, steps.ad.nbytes)
        return steps

    def _setting(self, run: Run) -> tuple[NDArray[np.int64], bool]:
        """Return the samples that set start states, and True if these are spread over the stretches."""
        if self.integrates and run.setting is not None:
            return run.setting, True
        starts, ends = _stretches_of(run)
        stop = np.minimum(starts + run.start_window, ends)
        return np.concatenate([np.arange(a, b) for a, b in zip(starts, stop, strict=True)]), False

    def _weights(self, run: Run) -> Array:
        """Return the weights (q,) of the outputs where they set start states."""
        return np.array([1.0 / (float(np.std(run.measured[o])) or 1.0) for o in self.outputs])

    def _run_affine(self, run: Run, steps: Steps, x0: Array, u: Array, values: Array) -> Array:
        """Return the states (n, s) of affine equations: from any start states, the best ones are one step away."""
        starts, ends = _stretches_of(run)
        reading = self._reading(run, values)
        x = steps.run(x0, u, starts, ends)
        y = self.equations.readings(x, u, run.t, values)
        rows = dict(zip(self.outputs, reading, strict=True))
        ss = start_state(steps.ad, rows, run if self.integrates else replace(run, setting=None))
        missed = ss.met(dict(zip(self.outputs, y.T, strict=True)), run.measured)
        x = x + run_pushed(steps.ad, np.zeros(x.shape), missed, starts, ends)
        if run.nearby is not None and not run.paths:
            pushes = self.typical * np.eye(self.typical.size)
            moved = [np.repeat(push[None, :], starts.size, axis=0) for push in pushes]
            states = np.stack([run_pushed(steps.ad, np.zeros(x.shape), x0, starts, ends) for x0 in moved], axis=-1)
            slopes = np.einsum("qi,nij->nqj", self._weights(run)[:, None] * reading, states[self._setting(run)[0]])
            run.nearby.of_stretches.setdefault(starts.tobytes(), Start(x[starts], states, slopes))
        return x

    def _reading(self, run: Run, values: Array) -> Array:
        """Return the slopes (q, s) of the outputs by the states for these numbers."""
        return remember(run.lasting, ("reading", values.tobytes()), lambda: self.linearised(values).c)

    @cached_property
    def has_exact_steps(self) -> bool:
        """Return True if the equations without forces are affine and no state has limits."""
        return self.equations.affine and all(s.lowest == -np.inf and s.highest == np.inf for s in self.state_list)

    @cached_property
    def reads_affine(self) -> bool:
        """Return True if the outputs are affine in states and signals."""
        return self.equations.reads_affine

    def exact_steps(self, dt: float, values: Array) -> Steps:
        """Return the steps of affine equations for these numbers."""
        return exact_steps(lambda x, u: self.equations.rates(x, u, values), self.typical, self.middle[1], dt, self.held)

    # -- linearised -----------------------------------------------------------------------------------

    def linearised(self, values: Array) -> Linearised:
        """Linearise about the mean of a run as given, for these numbers."""
        return linearise(self.equations, *self.middle, self.typical, values)

    def through(self, run: Run, signal: str, theta: Array, output: str) -> Callable[[Array], Array]:
        """See Twin; ``signal`` is an input or the name of a place."""
        lin = self.linearised(self.values(theta))
        at_once = np.zeros(len(self.outputs))
        if signal in self.signals:
            b, at_once = (of[:, self.signals.index(signal)] for of in (lin.b, lin.d))
        else:
            b = np.zeros(len(self.state_list))
            place = self.place(signal)
            b[place.target] = 1.0
            if place.kind == "joint":
                b[int(place.pairs[2])] = self.reaction(place, self.values(theta))
        d = discretise(lin.a, b, run.dt, self.holds.get(signal, "linear"))
        c = dict(zip(self.outputs, lin.c, strict=True))
        ss = start_state(d.ad, c, run if self.integrates else replace(run, setting=None))
        at = np.array(run.starts, np.int64)

        def carry(change: Array) -> Array:
            y = {
                o: run_output(d.ad, d.g0, d.g1, np.ascontiguousarray(c[o]), change, at) + gain * change
                for o, gain in zip(self.outputs, at_once.tolist(), strict=True)
            }
            free = ss.response(ss.states({o: -v for o, v in y.items()}), output, change.size)
            return y[output] + free

        return carry


def _stretches_of(run: Run) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the first sample of each stretch and the one behind its last."""
    return np.array(run.starts, np.int64), np.array((*run.starts[1:], run.t.size), np.int64)


def _settings(force: Force) -> tuple[object, ...]:
    return tuple(sorted(force.settings.items()))


def inside_of(twin: object) -> OdeTwin | None:
    """Return the equations of a twin, plain or corrected; None for a twin of another kind."""
    core = getattr(twin, "core", twin)
    return core if isinstance(core, OdeTwin) else None
