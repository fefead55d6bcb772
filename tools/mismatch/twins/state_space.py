"""Implements state-space twins: x' = A x + B u, y = C x + D u + y0, re-fitted through poles and numerators.

A free re-fit of A, B, C has no unique answer (any change of state coordinates gives the same twin). The data determine
the poles and, per input and output, the numerator coefficients: those are the base parameters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hal.arrays import ComplexArray
from sim_devices.physics.effect import Array, Human, Parameter
from sim_devices.physics.exponential import exponential
from tools.errors import RecordingError
from tools.mismatch.recording import Recording
from tools.mismatch.twins.dynamic import CONSTANT, DynamicTwin, Link, Plant
from tools.mismatch.twins.holds import Holds, holds_text, read_holds
from tools.mismatch.twins.linear import run_states
from tools.mismatch.twins.modes import Mode, chains_of, companion, modes_of, roots_of_mode, typical_size

_NAMES = ("A", "B", "C", "D", "x0", "y0", "hold", "discrete", "states", "first")
MAX_ORDER = 64
"""Largest number of modes of a plant."""


@dataclass(frozen=True)
class Matrices:
    """Holds the engineer's matrices after the checks."""

    a: Array
    b: Array
    c: Array
    d: Array
    x0: Array
    y0: Array
    discrete: bool
    holds: Holds


@dataclass(frozen=True)
class PoleBlocks:
    """Describes a plant by its poles: ``modes``, grouped in ``chains``, each chain one companion block.

    ``bounds`` are the first row and the last row + 1 of each block, ``sizes`` its typical rate in rad/s; ``place`` is
    where the parameters of a mode begin in theta (a fixed mode has none).
    """

    modes: Sequence[Mode]
    chains: Sequence[Sequence[int]]
    bounds: tuple[tuple[int, int], ...]
    sizes: tuple[float, ...]
    place: Mapping[int, int]
    discrete: bool
    dt: float

    def plant(self, theta: Array) -> Plant:
        """Return the block-diagonal plant for pole parameters ``theta``."""
        order = self.bounds[-1][1] if self.bounds else 0
        a, b = np.zeros((order, order)), np.zeros(order)
        for chain, size, (first, last) in zip(self.chains, self.sizes, self.bounds, strict=True):
            roots = np.concatenate([self._roots(i, theta) for i in chain])
            a[first:last, first:last], b[first:last] = companion(roots, size, self.discrete)
        return Plant(a, b, self.bounds if len(self.bounds) > 1 else ())

    def _roots(self, i: int, theta: Array) -> ComplexArray:
        mode = self.modes[i]
        if mode.kind == "fixed":
            return roots_of_mode(mode, self.discrete, self.dt)
        at = self.place[i]
        if mode.kind == "pair":
            w, z = theta[at], theta[at + 1]
            value = complex(-z * w, w * np.sqrt(max(1 - z * z, 0.0)))
        else:
            value = complex(float(np.sign(mode.value.real)) * theta[at])
        return roots_of_mode(Mode(mode.kind, value), self.discrete, self.dt)


class _Start:
    """Collects the parameters of a twin and the values from which their fit begins."""

    def __init__(self) -> None:
        self.parameters: list[Parameter] = []
        self.values: list[float] = []

    def add(self, parameter: Parameter, value: float) -> int:
        """Add a parameter; returns its place in theta."""
        self.parameters.append(parameter)
        self.values.append(value)
        return len(self.values) - 1


def state_space_twin(recording: Recording) -> DynamicTwin:
    """Build the twin; theta = pole parameters, scaled numerator coefficients, y0 of every output."""
    m = without_constant(read_matrices(recording), recording.dt)
    inputs, outputs = tuple(recording.inputs), tuple(recording.outputs)
    dt = recording.dt
    poles = felt_poles(m)
    if poles.size > MAX_ORDER:
        raise RecordingError(
            f"{recording.path}: [twin.parameters] A has {poles.size} modes that inputs move and outputs show;"
            f" at most {MAX_ORDER} are handled"
        )
    start = _Start()
    blocks = _pole_blocks(m, poles, recording, start)
    n_poles = len(start.values)
    links = _links(_numerators(m, blocks.plant(np.array(start.values)), poles), m.y0, blocks, recording, start)
    parameters = tuple(start.parameters)
    settled: dict[int, dict[str, Array]] = {}

    def fixed_free(n: int) -> Mapping[str, Array]:
        if n not in settled:
            settled.clear()
            y = np.zeros((n, len(outputs)))
            if np.any(m.x0 != 0):
                ad = np.ascontiguousarray(m.a if m.discrete else exponential(m.a * dt))
                still = np.zeros(ad.shape[0])
                x = run_states(ad, still, still, np.zeros(n), m.x0[None, :], np.zeros(1, np.int64))
                y = x @ m.c.T
            settled[n] = {o: y[:, k] for k, o in enumerate(outputs)}
        return settled[n]

    def human_of(theta: Array) -> Sequence[Human]:
        out = [Human(p.name, float(v), p.unit) for p, v in zip(parameters[:n_poles], theta, strict=False)]
        plant = blocks.plant(theta)
        if np.all(np.abs(np.linalg.eigvals(plant.a) - (1.0 if m.discrete else 0.0)) > 1e-9):
            for (k, i), g in np.ndenumerate(_dc_gain(plant, links, theta, inputs, outputs, m.discrete)):
                tag = "" if len(inputs) * len(outputs) == 1 else f"[{inputs[i]},{outputs[k]}]"
                unit = f"{recording.unit[outputs[k]]}/{recording.unit[inputs[i]]}"
                out.append(Human(f"dc_gain{tag}", float(g), unit))
        offsets = [(p, v) for p, v in zip(parameters, theta, strict=True) if p.name.startswith("y0")]
        return out + [Human(p.name, float(v), p.unit) for p, v in offsets]

    def text_of(theta: Array) -> dict[str, object]:
        return _text(blocks.plant(theta), links, theta, inputs, outputs, m)

    continuous = list(poles) if not m.discrete else [np.log(p + 0j) / dt for p in poles if abs(p) > 1e-12]
    # an oscillating mode does not integrate, however lightly it is damped
    slowest = min((abs(p) if abs(p.imag) > 1e-9 * abs(p) else -p.real for p in continuous), default=np.inf)
    seen = tuple(first for first, _ in blocks.bounds)
    return DynamicTwin(
        kind="state_space",
        inputs=inputs,
        outputs=outputs,
        units=recording.unit,
        chain=("amplifier", "actuator", "mechanics", "environment", "sensor", "acquisition"),
        parameters=parameters,
        holds=dict.fromkeys(inputs, "discrete") if m.discrete else m.holds,
        links=links,
        groups=tuple({o: seen} for o in outputs) if poles.size else (),
        begin=np.array(start.values),
        plant_of=blocks.plant,
        fixed_free=fixed_free,
        human_of=human_of,
        text_of=text_of,
        restart=bool(slowest * recording.n * dt < INTEGRATES),
        feedback_on=outputs[0] if len(inputs) == 1 and poles.size else "",
        fastest_per_s=float(np.max(np.abs(continuous))) if continuous else 0.0,
        start_given="x0" in recording.twin.parameters,
        at_rest="x0" in recording.twin.parameters and not np.any(m.x0),
    )


def _pole_blocks(m: Matrices, poles: ComplexArray, recording: Recording, start: _Start) -> PoleBlocks:
    """Group the poles in blocks, and add the parameters of their modes to ``start``."""
    dt = recording.dt
    modes = modes_of(poles, m.discrete, dt)
    chains = chains_of(modes, dt)
    bounds: list[tuple[int, int]] = []
    for chain in chains:
        at = bounds[-1][1] if bounds else 0
        bounds.append((at, at + sum(modes[i].order for i in chain)))
    sizes = [
        typical_size(np.concatenate([roots_of_mode(modes[i], m.discrete, dt) for i in c]), recording.n * dt)
        for c in chains
    ]
    free = [i for i, mode in enumerate(modes) if mode.kind != "fixed"]
    place: dict[int, int] = {}
    for number, i in enumerate(free, start=1):
        mode, tag = modes[i], f"_{number}" if len(free) > 1 else ""
        if mode.kind == "pair":
            w, z = abs(mode.value), -mode.value.real / abs(mode.value)
            # a plant that is stable as given stays stable
            least = 0.0 if z >= 0 else -0.5
            frequency = Parameter(f"natural_frequency{tag}", "rad/s", w / 30, w * 30, True, scale=0.01 * w)
            place[i] = start.add(frequency, w)
            start.add(Parameter(f"damping_ratio{tag}", "1", least, 0.9999, scale=max(0.02 * abs(z), 1e-3)), z)
        else:
            r = abs(mode.value.real)
            place[i] = start.add(Parameter(f"pole_rate{tag}", "1/s", r / 100, r * 100, True, scale=0.01 * r), r)
    return PoleBlocks(modes, chains, tuple(bounds), tuple(sizes), place, m.discrete, dt)


def _links(
    rows: Mapping[tuple[int, int], tuple[Array, float]],
    y0: Array,
    blocks: PoleBlocks,
    recording: Recording,
    start: _Start,
) -> tuple[Link, ...]:
    """Add numerators ``rows``, direct terms and offsets ``y0`` to ``start``; returns what connects them to outputs."""
    inputs, outputs = tuple(recording.inputs), tuple(recording.outputs)
    links: list[Link] = []
    single = len(inputs) * len(outputs) == 1
    for i, u in enumerate(inputs):
        for k, o in enumerate(outputs):
            c, direct = rows[k, i]
            unit = f"{recording.unit[o]}/({recording.unit[u]})"
            worst = float(np.max(np.abs(c), initial=0.0))
            for r in (r for first, last in blocks.bounds for r in range(first, last)):
                if worst > 0 and abs(c[r]) > 1e-7 * worst:
                    name = f"numerator_{r}" if single else f"numerator_{r}[{u},{o}]"
                    # nearly cancelling numerators have arbitrary sizes: the trust region is as wide as theirs
                    numerator = Parameter(name, unit, scale=max(abs(c[r]), 1e-3 * worst))
                    links.append(Link(start.add(numerator, float(c[r])), o, u, r))
            if direct != 0.0:
                term = Parameter(f"direct[{u},{o}]", "1", scale=abs(direct))
                links.append(Link(start.add(term, float(direct)), o, u, -1))
    for k, o in enumerate(outputs):
        typical = 0.01 * float(np.std(recording.outputs[o]))
        offset = Parameter("y0" if len(outputs) == 1 else f"y0[{o}]", recording.unit[o], scale=typical)
        links.append(Link(start.add(offset, float(y0[k])), o, CONSTANT, -2))
    return tuple(links)


def _matrix(recording: Recording, key: str, shape: tuple[int | None, int | None], missing: Array | None) -> Array:
    value = recording.twin.parameters.get(key)
    where = f"{recording.path}: [twin.parameters] {key}"
    if value is None:
        if missing is None:
            raise RecordingError(f"{where} is missing; a state_space twin needs A, B and C")
        return missing
    try:
        a = np.array(value, np.float64)
    except (ValueError, TypeError):
        raise RecordingError(f"{where} must be a list of rows of equal length, got {value!r}") from None
    if a.ndim < 2:
        a = a.reshape(1, -1) if shape[0] == 1 else a.reshape(-1, 1)
    bad = any(want is not None and want != have for want, have in zip(shape, a.shape, strict=True))
    if a.ndim == 2 and not bad and not np.all(np.isfinite(a)):
        i, k = np.argwhere(~np.isfinite(a))[0]
        raise RecordingError(f"{where}: row {i + 1}, column {k + 1} is {a[i, k]}; every entry must be a finite number")
    if a.ndim != 2 or bad:
        want = " x ".join("?" if w is None else str(w) for w in shape)
        raise RecordingError(f"{where} has shape {a.shape}, expected {want} numbers")
    return a


def read_matrices(recording: Recording) -> Matrices:
    text = recording.twin.parameters
    for key in text:
        if key not in _NAMES:
            raise RecordingError(
                f"{recording.path}: [twin.parameters] '{key}' is not a parameter of state_space;"
                f" known: {', '.join(_NAMES)}"
            )
    a = _matrix(recording, "A", (None, None), None)
    s, p, q = a.shape[0], len(recording.inputs), len(recording.outputs)
    if a.shape[1] != s:
        raise RecordingError(f"{recording.path}: [twin.parameters] A has shape {a.shape}, it must be square")
    holds = read_holds(recording)
    discrete = text.get("discrete", False)
    if not isinstance(discrete, bool):
        raise RecordingError(f"{recording.path}: [twin.parameters] discrete must be true or false, got {discrete!r}")
    x0 = _matrix(recording, "x0", (s, 1), np.zeros((s, 1)))
    y0 = _matrix(recording, "y0", (q, 1), np.zeros((q, 1)))
    return Matrices(
        a,
        _matrix(recording, "B", (s, p), None),
        _matrix(recording, "C", (q, s), None),
        _matrix(recording, "D", (q, p), np.zeros((q, p))),
        x0[:, 0],
        y0[:, 0],
        discrete,
        holds,
    )


def without_constant(m: Matrices, dt: float) -> Matrices:
    """Return the twin with a constant state (an eigenvalue of zero that no input moves) written as an offset.

    Such a state expresses an affine model as a linear one. Its value is a parameter of the twin and no start state: it
    becomes part of ``y0``, together with its steady-state response. A state that drives an integrator is kept.
    """
    s = m.a.shape[0]
    if not s or not np.any(m.x0):
        return m
    zero = 1.0 if m.discrete else 0.0
    size = max(float(np.max(np.abs(m.a))), 1e-300)
    # rows of A that keep their state constant, and rows of B that do not move it
    still = [
        i
        for i in range(s)
        if np.all(np.abs(m.a[i] - zero * (np.arange(s) == i)) <= 1e-12 * size) and not np.any(m.b[i])
    ]
    rest = [i for i in range(s) if i not in still]
    if not still:
        return m
    held = m.x0[still]
    a = m.a[np.ix_(rest, rest)]
    push = m.a[np.ix_(rest, still)] @ held
    settled = np.zeros(len(rest))
    if np.any(push):
        system = zero * np.eye(len(rest)) - a
        if np.linalg.cond(system) > 1e10:
            return m
        settled = np.linalg.solve(system, push)
    y0 = m.y0 + m.c[:, still] @ held + m.c[:, rest] @ settled
    return replace(m, a=a, b=m.b[rest], c=m.c[:, rest], x0=m.x0[rest] - settled, y0=y0)


def felt_poles(m: Matrices) -> ComplexArray:
    """Return the poles (closed under conjugation) of the observable modes: controllable ones first.

    A pole that several inputs move through copies of one block counts once.
    """
    linked = m.a != 0.0
    observable = _reached(linked.T, np.any(m.c != 0.0, axis=0))
    moved = np.zeros_like(observable)
    found: list[complex] = []
    for i in range(m.b.shape[1]):
        here = _reached(linked, m.b[:, i] != 0.0)
        found = _joined(found, _eigenvalues(m.a, here & observable))
        moved |= here
    return np.array([*found, *_eigenvalues(m.a, observable & ~moved)], np.complex128)


def _reached(linked: NDArray[np.bool_], begin: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a mask (s,) of the states reachable from those of ``begin``; ``linked[i, j]``: state j moves state i."""
    found = begin.copy()
    while True:
        more = found | np.any(linked[:, found], axis=1)
        if np.array_equal(more, found):
            return found
        found = more


def _eigenvalues(a: Array, states: NDArray[np.bool_]) -> list[complex]:
    """Return the eigenvalues of these states block by block: copies of a block give identical values."""
    left = np.flatnonzero(states).tolist()
    linked = (a != 0.0) | (a != 0.0).T
    out: list[complex] = []
    while left:
        begin = np.zeros(a.shape[0], np.bool_)
        begin[left[0]] = True
        block = _reached(linked & states & states[:, None], begin)
        rows = np.flatnonzero(block)
        out += [complex(p) for p in np.linalg.eigvals(a[np.ix_(rows, rows)])]
        left = [r for r in left if not block[r]]
    return out


def _joined(found: list[complex], more: Sequence[complex]) -> list[complex]:
    """Return ``found`` with those of ``more`` that are not in it yet."""
    rest = list(found)
    out = list(found)
    for p in more:
        near = min(rest, key=lambda q: abs(q - p), default=None)
        if near is not None and abs(near - p) <= SAME_POLE * max(abs(p), abs(near), 1e-300):
            rest.remove(near)
        else:
            out.append(p)
    return out


INTEGRATES = 0.5
"""Decay over the whole record (nepers) below which a pole integrates: a run then restarts in every stretch."""
SAME_POLE = 1e-6
"""Relative distance below which poles of different inputs are the same pole."""


def _numerators(m: Matrices, plant: Plant, poles: ComplexArray) -> dict[tuple[int, int], tuple[Array, float]]:
    """Return rows c with c (p - a)^-1 b equal to the given transfer function, per output and input.

    They are matched at points of the complex plane near every pole, where each mode is strongest.
    """
    s, n = plant.a.shape[0], m.a.shape[0]
    size = float(np.max(np.abs(poles - (1.0 if m.discrete else 0.0)), initial=0.0)) or 1.0
    away = 0.3 * np.maximum(np.abs(poles - (1.0 if m.discrete else 0.0)), 1e-3 * size)
    points = np.concatenate([poles + away, poles + away * np.exp(2.1j), poles + away * np.exp(4.4j)])
    both = lambda x: np.concatenate([x.real, x.imag])  # noqa: E731
    out: dict[tuple[int, int], tuple[Array, float]] = {}
    basis = np.array([np.linalg.solve(p * np.eye(s) - plant.a, plant.b) for p in points]).reshape(points.size, s)
    want = np.array([m.c @ np.linalg.solve(p * np.eye(n) - m.a, m.b) for p in points])
    rows = both(basis)
    scale = np.linalg.norm(rows, axis=0) if s else np.zeros(0)
    for k in range(m.c.shape[0]):
        for i in range(m.b.shape[1]):
            c = np.linalg.lstsq(rows / scale, both(want[:, k, i]), rcond=None)[0] / scale if s else np.zeros(0)
            out[k, i] = (np.asarray(c, np.float64), float(m.d[k, i]))
    return out


def _rows(
    links: Sequence[Link], theta: Array, inputs: tuple[str, ...], outputs: tuple[str, ...], s: int
) -> tuple[Array, Array, Array]:
    """Return C over block-diagonal companions (q, s * p), D (q, p) and y0 (q,)."""
    c = np.zeros((len(outputs), s * len(inputs)))
    d = np.zeros((len(outputs), len(inputs)))
    y0 = np.zeros(len(outputs))
    for link in links:
        k = outputs.index(link.output)
        if link.row == -2:
            y0[k] = theta[link.j]
        elif link.row == -1:
            d[k, inputs.index(link.source)] = theta[link.j]
        else:
            c[k, inputs.index(link.source) * s + link.row] = theta[link.j]
    return c, d, y0


def _dc_gain(
    plant: Plant, links: Sequence[Link], theta: Array, inputs: tuple[str, ...], outputs: tuple[str, ...], z: bool
) -> Array:
    s = plant.a.shape[0]
    c, d, _ = _rows(links, theta, inputs, outputs, s)
    settled = np.linalg.solve((np.eye(s) if z else 0) - plant.a, plant.b)
    return np.stack([c[:, i * s : (i + 1) * s] @ settled for i in range(len(inputs))], axis=1) + d


def _text(
    plant: Plant, links: Sequence[Link], theta: Array, inputs: tuple[str, ...], outputs: tuple[str, ...], m: Matrices
) -> dict[str, object]:
    s, p = plant.a.shape[0], len(inputs)
    c, d, y0 = _rows(links, theta, inputs, outputs, s)
    a = np.kron(np.eye(p), plant.a)
    b = np.zeros((s * p, p))
    for i in range(p):
        b[i * s : (i + 1) * s, i] = plant.b
    out: dict[str, object] = {"A": a.tolist(), "B": b.tolist(), "C": c.tolist(), "D": d.tolist(), "y0": y0.tolist()}
    out["hold"] = holds_text(m.holds)
    if m.discrete:
        out["discrete"] = True
    return out
