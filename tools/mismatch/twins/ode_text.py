"""Builds a twin of differential equations from a ``[twin]`` table with equations or a named Python function."""

from __future__ import annotations

import keyword
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.trust import path_inside, trusted_program
from sim_devices.physics.effect import Array, Parameter
from sim_devices.physics.parameter import OWN_SIGN, RATE_SIGN
from tools.errors import RecordingError, refuse_unknown_keys
from tools.guest.equations import Builder, EquationError, builder_of
from tools.guest.host import GuestError, GuestProcess
from tools.mismatch import units
from tools.mismatch.recording import Recording
from tools.mismatch.twins.equations import Equations, Programs, State, linearise, rates_at
from tools.mismatch.twins.holds import STRAIGHT_OR_HELD, read_holds
from tools.mismatch.twins.ode import FORGOTTEN, OdeTwin
from tools.mismatch.twins.ode_inside import NOTHING, Place
from tools.mismatch.twins.ode_run import Drive
from tools.mismatch.twins.program import parse
from tools.numbers import is_finite_number

TABLES = ("states", "equations", "outputs", "offsets", "units", "function", "fixed", "hold")
"""Keys of an ode twin that are not numbers; they stand beside ``parameters`` in ``[twin]``, or inside it."""
WIDEST = 100.0
"""Largest factor between a parameter that is searched by its logarithm and the engineer's own value."""
PROBES = 5


def ode_twin(recording: Recording) -> OdeTwin:
    """Build the twin that a recording's table describes. Raises RecordingError that names the key and the remedy."""
    table = recording.twin.parameters
    where = f"{recording.path}: [twin]"
    unknown = [k for k, v in table.items() if k not in TABLES and not is_finite_number(v)]
    if unknown:
        raise RecordingError(
            f"{where} {unknown[0]} = {table[unknown[0]]!r} is neither a finite number nor one of {', '.join(TABLES)}"
        )
    names = tuple(k for k in table if k not in TABLES)
    states = _states(where, table.get("states"))
    signals = (*recording.inputs, *recording.context)
    for name in (*(s.name for s in states), *signals, *names):
        if not re.fullmatch(r"[A-Za-z_]\w*", name) or keyword.iskeyword(name) or name in ("t", "pi"):
            raise RecordingError(f"{where} '{name}' cannot be used in an equation; give it another name")
    offsets = _offsets(where, recording, table, {*(s.name for s in states), *signals, *names})
    every = ("t", *(s.name for s in states), *signals, *names, *offsets)
    twice = {n for n in every if every.count(n) > 1}
    if twice:
        raise RecordingError(f"{where} '{twice.pop()}' names two things among states, signals and parameters")
    try:
        equations = _programs(recording, states, signals, names, offsets)
    except EquationError as error:
        raise RecordingError(f"{where} {error}") from None
    return _assembled(recording, equations, states, signals, names, offsets)


def _offsets(where: str, recording: Recording, table: Mapping[str, Any], others: Collection[str]) -> dict[str, float]:
    """Return the offset of every output, by its name as a parameter; none where one of ``others`` has it.

    A sensor's zero is no physics that is missing: without it a constant would be named as a step or a curve. An
    engineer who has a parameter of that name has it in the equations.
    """
    own = [o for o in recording.outputs if offset_name(o) not in others]
    given = table.get("offsets", {})
    if not isinstance(given, Mapping) or any(o not in own or not is_finite_number(v) for o, v in given.items()):
        raise RecordingError(f"{where} offsets must give a number for an output ({', '.join(own)}), got {given!r}")
    return {offset_name(o): float(given.get(o, 0.0)) for o in own}


def offset_name(output: str) -> str:
    """Return the name of the offset of an output among the parameters."""
    return f"{output}_offset"


def _assembled(
    recording: Recording,
    equations: Equations,
    states: tuple[State, ...],
    signals: tuple[str, ...],
    own: Sequence[str],
    offsets: Mapping[str, float],
) -> OdeTwin:
    """Build the twin around its equations, with typical sizes from a run as given; ``own``: the engineer's numbers."""
    table, where = recording.twin.parameters, f"{recording.path}: [twin]"
    names = (*own, *offsets)
    numbers = {**{n: float(table[n]) for n in own}, **offsets}
    holds = read_holds(recording, STRAIGHT_OR_HELD)
    held = np.array([holds.get(s) == "zero" for s in signals])
    fixed = table.get("fixed", [])
    if not isinstance(fixed, Sequence) or isinstance(fixed, str) or not all(isinstance(f, str) for f in fixed):
        raise RecordingError(f"{where} fixed must list parameters that stay as given, by their names; got {fixed!r}")
    refuse_unknown_keys(f"{where} fixed:", fixed, names, "parameter")
    own_units = table.get("units", {})
    if not isinstance(own_units, Mapping) or not all(isinstance(u, str) for u in own_units.values()):
        raise RecordingError(f"{where} units must give the unit of each parameter as text")
    free = tuple(i for i, n in enumerate(names) if n not in fixed)
    values = np.array([numbers[n] for n in names])
    scale = {n: 0.01 * abs(v) or 1e-3 for n, v in numbers.items()}
    # small beside those of the engineer's own numbers: a constant that one of these makes as well is left to it
    offset_of = {offset_name(o): o for o in recording.outputs if offset_name(o) in offsets}
    scale |= {n: 1e-4 * float(np.ptp(recording.outputs[o])) or 1e-3 for n, o in offset_of.items()}
    u = np.column_stack([recording.signals[s] for s in signals])
    x = _as_given(recording, equations, states, u, values, held)
    typical = _typical(x, states)
    middle = (np.asarray(x.mean(axis=0), np.float64), np.asarray(u.mean(axis=0), np.float64))
    rates: list[complex] = []
    for k in np.linspace(0, recording.n - 1, 7).astype(int):
        a = linearise(equations, x[k], u[k], typical, values).a
        rates += np.linalg.eigvals(a).tolist() if np.all(np.isfinite(a)) else []
    if not rates:
        raise RecordingError(f"{where} the derivatives are not finite where the states start; check 'start' of each")
    about = np.linalg.eigvals(linearise(equations, *middle, typical, values).a)
    slopes = linearise(equations, *middle, typical, values).a
    places = _places(equations, states, x, u, values, slopes)
    places = (*places, *_joints(places, states, x, slopes))
    changing = [i for i in free if names[i] not in offsets]
    places = (*places, *_parameters(recording, states, signals, names, changing))
    if recording.twin.kind == "ode":
        first = 1 + len(states) + len(signals)
        for i, j, way in _directions(equations, places, x, u, values, changing):
            name = f"{names[i]} by {'sign' if way == OWN_SIGN else 'direction'} of {states[j].name}"
            places = (*places, Place(name, "direction", j, j, 0, states[j].unit, (float(first + i), 1.0 + j, way)))
        for i, j in _state_pairs(equations, x, u, values, changing):
            name = f"{names[i]} by {states[j].name}"
            places = (*places, Place(name, "state", j, j, 0, states[j].unit, (float(first + i), 1.0 + j)))
    units_of = {**own_units, **{n: recording.unit[o] for n, o in offset_of.items()}}

    def text_of(found: Mapping[str, float]) -> dict[str, object]:
        moved = {o: found.get(n, offsets[n]) for n, o in offset_of.items()}
        beside = {"offsets": {o: v for o, v in moved.items() if v}} if any(moved.values()) else {}
        return {**{k: found.get(k, v) for k, v in table.items() if k != "offsets"}, **beside}

    integrates = bool(np.min(-about.real) * recording.n * recording.dt < FORGOTTEN)
    return OdeTwin(
        kind=recording.twin.kind,
        inputs=tuple(recording.inputs),
        outputs=tuple(recording.outputs),
        units=recording.unit,
        chain=("amplifier", "actuator", "mechanics", "environment", "sensor", "acquisition"),
        parameters=tuple(
            Parameter(n, str(units_of.get(n, "")), *_range(values[i], log), log=log, scale=scale[n])
            for i, n, log in ((i, names[i], _one_sign(equations, x, u, values, i)) for i in free)
        ),
        equations=equations,
        state_list=states,
        signals=signals,
        names=names,
        free=free,
        given=numbers,
        holds=holds,
        text_of=text_of,
        parameter_units=units_of,
        typical=typical,
        middle=middle,
        places=places,
        fastest_per_s=float(np.max(np.abs(rates))),
        restart=integrates,
        integrates=integrates,
        feedback_on=next(iter(recording.outputs)) if places else "",
    )


def _as_given(
    recording: Recording,
    equations: Equations,
    states: tuple[State, ...],
    u: Array,
    values: Array,
    held: NDArray[np.bool_],
) -> Array:
    """Return states (n, s) of a free run with the engineer's numbers from the engineer's start."""
    n = u.shape[0]
    x0 = np.array([[state.start for state in states]])
    limits = (np.array([state.lowest for state in states]), np.array([state.highest for state in states]))
    typical = np.maximum(np.abs(x0[0]), 1.0)
    with np.errstate(all="ignore"):
        a = linearise(equations, x0[0], u[0], typical, values).a
        fastest = float(np.max(np.abs(np.linalg.eigvals(a)))) if np.all(np.isfinite(a)) else 1.0 / recording.dt
        sub = int(np.clip(np.ceil(recording.dt * fastest / 0.25), 1, 200))
        inputs = np.ascontiguousarray(u)
        whole = np.zeros(1, np.int64), np.array([n], np.int64)
        drive = Drive(inputs, held, recording.t, recording.dt, sub, 1, *whole)
        x = equations.states(x0, drive, values, NOTHING, limits)
    if not np.all(np.isfinite(x)):
        k = int(np.argmax(~np.isfinite(x).all(axis=1)))
        name = states[int(np.argmax(~np.isfinite(x[k])))].name
        raise RecordingError(
            f"{recording.path}: [twin] state '{name}' is {x[k][~np.isfinite(x[k])][0]} at sample {k} of a run with your"
            " own parameters; check the equations, their units and 'start' of each state"
        )
    return x


def _typical(x: Array, states: tuple[State, ...]) -> Array:
    """Return the size of each state in a run: its spread, or its value if it is constant."""
    size = np.std(x, axis=0)
    return np.where(size > 0.0, size, np.maximum(np.max(np.abs(x), axis=0), 1e-6))


def _places(
    equations: Equations, states: tuple[State, ...], x: Array, u: Array, values: Array, slopes: Array
) -> tuple[Place, ...]:
    """Classify states: one whose derivative is another state is a position, the other its velocity, the rest storages.

    The relation is tested at randomly perturbed points of a run.
    """
    rng = np.random.default_rng(0)
    s = x.shape[1]
    at = x[rng.integers(0, x.shape[0], PROBES)] + np.std(x, axis=0) * rng.standard_normal((PROBES, s))
    beside = u[rng.integers(0, u.shape[0], PROBES)] + np.std(u, axis=0) * rng.standard_normal((PROBES, u.shape[1]))
    f = rates_at(equations, at, beside, values)
    out: list[Place] = []
    positions: dict[int, int] = {}
    for i in range(s):
        for j in range(s):
            ratio = f[:, i] / np.where(at[:, j] == 0.0, np.nan, at[:, j])
            if i != j and np.all(np.isfinite(ratio)) and ratio[0] != 0.0 and np.ptp(ratio) < 1e-9 * abs(ratio[0]):
                positions.setdefault(j, i)
    for j, state in enumerate(states):
        if j in positions:
            out.append(Place(state.name, "motion", positions[j], j, j, states[positions[j]].unit))
        elif _is_velocity(state.unit):
            out.append(Place(state.name, "motion", j, j, j, state.unit.removesuffix("/s")))
        elif j not in positions.values():
            out.append(Place(state.name, "storage", j, j, j, state.unit))
    stores = [p.target for p in out if p.kind == "storage"]
    into = {i: [i, *(j for j in stores if j != i and slopes[j, i] != 0.0)] for i in stores}
    out = [replace(p, pairs=_flat({p.target: into[p.target]})) if p.kind == "storage" else p for p in out]
    if len(stores) > 1:
        first = stores[0]
        name = "+".join(states[i].name for i in stores)
        out.append(Place(name, "storages", first, first, first, states[first].unit, _flat(into)))
    return tuple(out)


def _joints(places: Sequence[Place], states: tuple[State, ...], x: Array, slopes: Array) -> list[Place]:
    """Return the springs between two positions, whose travel is ``x_1 - b x_2``; x: states (n, s) of a run as given.

    A side without a spring of its own to ground moves with the joint alone, and so shows b. Either may be that side.
    """
    moving = [p for p in places if p.kind == "motion" and p.position != p.velocity]
    out: list[Place] = []
    for k, p in enumerate(moving):
        for q in moving[k + 1 :]:
            to, back = slopes[p.target, q.position], slopes[q.target, p.position]
            own, others = slopes[p.target, p.position], slopes[q.target, q.position]
            if to * back <= 0.0 or own * to >= 0.0 or others * back >= 0.0:
                continue
            ratios = [float(-to / own), float(-others / back)]
            if abs(ratios[0] - ratios[1]) < SAME_RATIO * abs(ratios[0]):
                ratios = ratios[:1]
            for b in ratios:
                sizes = [float(np.std(x[:, p.position] - b * x[:, q.position]))]
                sizes += [float(np.std(x[:, p.velocity] - b * x[:, q.velocity]))]
                name = f"{states[p.position].name} - {b:.4g} {states[q.position].name}"
                name = name.replace(" 1 ", " ")
                sides = (q.position, q.velocity, q.target, b, *(s or 1e-9 for s in sizes))
                one = Place(name, "joint", p.position, p.velocity, p.target, p.unit, tuple(map(float, sides)))
                out.append(one)
    return out


SAME_RATIO = 0.01
"""Relative difference of the two ratios of a joint below which they are one."""


def _parameters(
    recording: Recording,
    states: tuple[State, ...],
    signals: tuple[str, ...],
    names: Sequence[str],
    free: Sequence[int],
) -> list[Place]:
    """Pair each parameter that may be re-fitted with each recorded signal that is no input of the twin."""
    first = 1.0 + len(states)
    return [
        Place(
            f"{names[i]} by {s}", "parameter", k, k, 0, recording.unit[s], (float(first + len(signals) + i), first + k)
        )
        for k, s in enumerate(signals)
        if s in recording.context
        for i in free
    ]


PAIRED, APART = 60, 1e-6
"""Number of points of a run at which parameters that follow states are compared, and the least share of what one
changes in the derivatives that neither the constant parameters nor another one changes as well."""


def _state_pairs(equations: Equations, x: Array, u: Array, values: Array, free: Sequence[int]) -> list[tuple[int, int]]:
    """Return (parameter, state): each parameter of a derivative, with a state that it may follow.

    Left out is what changes the derivatives as constant parameters do (a heating power that follows the temperature,
    beside a loss in proportion to it), and of those that do the same all but the first.
    """
    at = np.linspace(0, x.shape[0] - 1, min(PAIRED, x.shape[0])).astype(int)
    some, beside = x[at], u[at]
    as_given = rates_at(equations, some, beside, values)
    scale = np.maximum(np.max(np.abs(as_given), axis=0), 1e-300)
    slopes: dict[int, Array] = {}
    for i in free:
        changed, step = values.copy(), 1e-4 * (abs(values[i]) or 1.0)
        changed[i] += step
        slope = (rates_at(equations, some, beside, changed) - as_given) / step / scale
        if np.all(np.isfinite(slope)) and np.any(slope):
            slopes[i] = slope / np.linalg.norm(slope)
    known, out = [s.ravel() for s in slopes.values()], list[tuple[int, int]]()
    for i, slope in slopes.items():
        for j in range(x.shape[1]):
            column = (slope * (some[:, j] - np.mean(some[:, j]))[:, None]).ravel()
            size = np.linalg.norm(column)
            if not size > 0.0:
                continue
            left = column - (basis := np.column_stack(known)) @ np.linalg.lstsq(basis, column)[0]
            if np.linalg.norm(left) > APART * size:
                out.append((i, j))
                known.append(column / size)
    return out


def _directions(
    equations: Equations, places: Sequence[Place], x: Array, u: Array, values: Array, free: Sequence[int]
) -> list[tuple[int, int, float]]:
    """Return (parameter, state, way): each parameter of a derivative, with a state whose direction it may follow.

    That is the state itself, or of a velocity its position. A position may have a parameter of its own: the gain of a
    valve, where its opening counts as the velocity. A velocity without a position has a direction of its own where its
    sign changes.
    """
    at = np.linspace(0, x.shape[0] - 1, PROBES).astype(int)
    as_given = rates_at(equations, x[at], u[at], values)
    acted_on = [p for p in places if p.kind in ("motion", "storage")]
    follows = {**{j: [j] for j in range(x.shape[1])}, **{p.target: list[int]() for p in acted_on}}
    for p in acted_on:
        follows[p.target].append(p.position)
    turning = {p.target for p in acted_on if p.kind == "motion" and p.position == p.velocity}
    turning = {j for j in turning if np.min(x[:, j]) < 0.0 < np.max(x[:, j])}
    out: list[tuple[int, int, float]] = []
    for i in free:
        changed = values.copy()
        changed[i] = values[i] * 1.01 if values[i] else 1e-3
        differs = np.any(rates_at(equations, x[at], u[at], changed) != as_given, axis=0)
        out += [(i, j, RATE_SIGN) for j in dict.fromkeys(j for k, of in follows.items() if differs[k] for j in of)]
        out += [(i, j, OWN_SIGN) for j in sorted(turning) if differs[j]]
    return out


def _one_sign(equations: Equations, x: Array, u: Array, values: Array, i: int) -> bool:
    """Return True if a parameter that is given as positive cannot be zero: something is divided by it, as by a mass or
    a time constant, or its root is taken.

    Its size is searched by the logarithm; beside missing physics it would otherwise run to zero. An angle in a sine is
    no such parameter, and may change its sign.
    """
    if values[i] <= 0.0:
        return False
    at = np.linspace(0, x.shape[0] - 1, PROBES).astype(int)
    some, beside = np.ascontiguousarray(x[at]), np.ascontiguousarray(u[at])

    def changed(factor: float) -> Array:
        v = values.copy()
        v[i] *= factor
        rates = rates_at(equations, some, beside, v)
        return np.concatenate([rates, equations.readings(some, beside, np.zeros(at.size), v)], axis=1)

    with np.errstate(all="ignore"):
        one, double, tiny, other = changed(1.0), changed(2.0), changed(1e-6), changed(-1.0)
        grows = np.abs(tiny - one) > 1e3 * np.abs(double - one)
    changes = double != one
    return bool(np.any((grows | ~np.isfinite(tiny) | ~np.isfinite(other)) & changes & np.isfinite(one)))


def _range(value: float, log: bool) -> tuple[float, float]:
    return (value / WIDEST, value * WIDEST) if log else (-np.inf, np.inf)


def _flat(into: Mapping[int, Sequence[int]]) -> tuple[float, ...]:
    return tuple(float(v) for i, others in into.items() for j in others for v in (i, j))


def _is_velocity(unit: str) -> bool:
    try:
        dimension = units.parse(unit).dimension
    except units.UnitError:
        return False
    return dimension in (units.parse("m/s").dimension, units.parse("rad/s").dimension)


def _states(where: str, table: object) -> tuple[State, ...]:
    if not isinstance(table, Mapping) or not table:
        raise RecordingError(f"{where} states must name each state with its unit, as in states = {{ v = 'm/s' }}")
    out: list[State] = []
    for name, entry in table.items():
        if isinstance(entry, str):
            entry = {"unit": entry}
        known = {"unit", "start", "min", "max"}
        if not isinstance(entry, Mapping) or set(entry) - known or not isinstance(entry.get("unit", "1"), str):
            raise RecordingError(f"{where} states.{name} must be a unit, or a table with {', '.join(sorted(known))}")
        for key in ("start", "min", "max"):
            if key in entry and not is_finite_number(entry[key]):
                raise RecordingError(f"{where} states.{name} {key} must be a finite number, got {entry[key]!r}")
        low, high = float(entry.get("min", -np.inf)), float(entry.get("max", np.inf))
        start = float(entry.get("start", min(max(0.0, low), high)))
        if not low <= start <= high or low == high:
            raise RecordingError(f"{where} states.{name}: start {start} does not lie between min {low} and max {high}")
        try:
            units.parse(entry.get("unit", "1"))
        except units.UnitError as error:
            raise RecordingError(f"{where} states.{name}: {error}") from None
        out.append(State(str(name), entry.get("unit", "1"), start, low, high))
    return tuple(out)


def _programs(
    recording: Recording,
    states: tuple[State, ...],
    signals: tuple[str, ...],
    names: tuple[str, ...],
    offsets: Mapping[str, float],
) -> Programs:
    """Build equations from text, or by tracing the named Python function. Raises EquationError."""
    table = recording.twin.parameters
    every = ("t", *(s.name for s in states), *signals, *names, *offsets)
    texts, function = table.get("equations"), table.get("function")
    if (texts is None) == (function is None):
        raise EquationError("needs either equations, or function = 'file.py:name'")
    own = [s.name for s in states]
    builder = Builder(every)
    if texts is not None:
        texts = _texts("equations", texts)
        missing = [s for s in own if s not in texts]
        if missing:
            raise EquationError(f"no equation for the derivative of state '{missing[0]}'")
        # the name of a state means its value inside an equation, and its derivative as the name of an equation
        renamed = {f"derivative of {k}" if k in own else k: v for k, v in texts.items()}
        clash = [k for k in texts if k in every and k not in own]
        if clash:
            raise EquationError(f"'{clash[0]}' is a signal or a parameter and cannot have an equation")
        results = parse(builder, renamed, [f"derivative of {s}" for s in own])
        beside = {k: v for k, v in texts.items() if k not in own}
    else:
        groups = {"states": own, "inputs": signals, "parameters": names}
        builder, found = _traced(recording, function, every, groups)
        missing = [s for s in own if s not in found]
        if missing:
            raise EquationError(f"derivatives returned {', '.join(found) or 'nothing'}, and no '{missing[0]}'")
        results = [found[s] for s in own]
        beside = {}
    outputs = _texts("outputs", table.get("outputs", {}))
    reader = Builder(every)
    for o in recording.outputs:
        if o not in outputs and o not in own:
            raise EquationError(f"output '{o}' is no state; say under outputs how it is read, such as {o} = '{own[0]}'")
    added = {o: f" + {offset_name(o)}" if offset_name(o) in offsets else "" for o in recording.outputs}
    readings = {f"output {o}": f"({outputs.get(o, o)}){zero}" for o, zero in added.items()}
    read = parse(reader, {**beside, **readings}, list(readings))
    return Programs(builder.program(results), reader.program(read), 1 + len(own) + len(signals))


def _texts(key: str, table: object) -> dict[str, str]:
    if not isinstance(table, Mapping):
        raise EquationError(
            f'{key} must be a table: the line [twin.{key}], and below it NAME = "an equation as text" each'
        )
    out: dict[str, str] = {}
    for name, text in table.items():
        if not isinstance(text, str | int | float) or isinstance(text, bool):
            raise EquationError(f"{key}.{name} must be text, got {text!r}")
        out[str(name)] = str(text)
    return out


def _traced(
    recording: Recording, name: object, names: tuple[str, ...], groups: Mapping[str, Sequence[str]]
) -> tuple[Builder, dict[str, int]]:
    """Trace ``file.py:name`` beside the recording to operations and results, once, in a process of its own.

    Raises EquationError, and ``NotTrusted`` for a file that the user has not trusted.
    """
    if not isinstance(name, str) or ":" not in name:
        raise EquationError(f"function must be 'file.py:name' with a file beside the recording, got {name!r}")
    file, _, attribute = name.rpartition(":")
    path = path_inside(recording.path, file)
    if not path.is_file():
        raise EquationError(f"function: {path} does not exist")
    source = trusted_program(path, recording.path).decode("utf-8-sig", "replace")
    request = {"ask": "trace", "path": str(path), "source": source, "attribute": attribute}
    guest = GuestProcess(str(path), {**request, "names": names, "groups": groups})
    try:
        head, arrays = guest.opened()
    except GuestError as error:
        reason = f"{error}" if error.kind == "EquationError" else f"{path} cannot be loaded ({error.kind}: {error})"
        raise EquationError(f"function: {reason}") from error
    finally:
        guest.end()
    try:
        return builder_of(names, head["operations"], arrays["registers"], head["results"])
    except (KeyError, ValueError, TypeError) as error:
        raise EquationError(f"function: {path} gave something that is no list of operations ({error})") from error
