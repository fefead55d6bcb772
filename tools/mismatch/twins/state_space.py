"""State space: x' = A x + B u, y = C x + D u + y0, re-fitted through its poles and its numerators.

Re-fitting A, B, C freely has no unique answer (any change of state coordinates gives the same twin). What the
data can say are the poles and, per input and output, the numerator coefficients: those are the base parameters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_devices.physics.effect import Array, Human, Parameter
from sim_devices.physics.exponential import exponential
from tools.mismatch.recording import Recording, RecordingError
from tools.mismatch.twins.dynamic import CONSTANT, DynamicTwin, Link, Plant
from tools.mismatch.twins.linear import Hold

_NAMES = ("A", "B", "C", "D", "x0", "y0", "hold", "discrete")
MAX_ORDER = 12


Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class Matrices:
    """The engineer's matrices, checked."""

    a: Array
    b: Array
    c: Array
    d: Array
    x0: Array
    y0: Array
    discrete: bool
    hold: Hold


def state_space_twin(recording: Recording) -> DynamicTwin:
    """theta = pole parameters, numerator coefficients (in units of the given scale), y0 of every output."""
    m = _matrices(recording)
    inputs, outputs = tuple(recording.inputs), tuple(recording.outputs)
    dt, s = recording.dt, m.a.shape[0]
    poles = np.asarray(np.linalg.eigvals(m.a), np.complex128)
    modes, fixed = _modes(poles, m.discrete, dt)
    # companion states are scaled by omega^k so that they are of one size
    omega = 1.0 / dt if m.discrete else _omega(poles, recording.n * dt)
    parameters: list[Parameter] = []
    begin: list[float] = []
    for i, (kind, value) in enumerate(modes):
        tag = f"_{i + 1}" if len(modes) > 1 else ""
        if kind == "pair":
            w, z = abs(value), -value.real / abs(value)
            parameters.append(Parameter(f"natural_frequency{tag}", "rad/s", w / 30, w * 30, True, scale=0.01 * w))
            parameters.append(Parameter(f"damping_ratio{tag}", "1", -0.5, 0.9999, scale=max(0.02 * abs(z), 1e-3)))
            begin += [w, z]
        else:
            r = abs(value.real)
            parameters.append(Parameter(f"pole_rate{tag}", "1/s", r / 100, r * 100, True, scale=0.01 * r))
            begin.append(r)
    signs = [float(np.sign(v.real)) for _, v in modes]
    kinds = [k for k, _ in modes]

    def denominator(theta: Array) -> Array:
        roots: list[complex] = list(fixed)
        at = 0
        for kind, sign in zip(kinds, signs, strict=True):
            if kind == "pair":
                w, z = theta[at], theta[at + 1]
                p = complex(-z * w, w * np.sqrt(max(1 - z * z, 0.0)))
                roots += [p, p.conjugate()]
                at += 2
            else:
                roots.append(complex(sign * theta[at]))
                at += 1
        if m.discrete:
            done = roots[len(fixed) :]
            roots = [*fixed, *(np.exp(p * dt) for p in done)]
        return np.asarray(np.real(np.poly(roots)), np.float64) if roots else np.ones(1)

    def plant_of(theta: Array) -> Plant:
        den = denominator(theta)
        a = np.zeros((s, s))
        b = np.zeros(s)
        if s:
            scale = 1.0 if m.discrete else omega
            a[:-1, 1:] = scale * np.eye(s - 1)
            a[-1, :] = -den[:0:-1] / (scale ** np.arange(s - 1, -1, -1.0))
            b[-1] = 1.0 if m.discrete else scale
        return Plant(a, b)

    rows = _numerators(m, plant_of(np.array(begin)))
    links: list[Link] = []
    for i, u in enumerate(inputs):
        for k, o in enumerate(outputs):
            c, direct = rows[k, i]
            worst = float(np.max(np.abs(c))) if s else 0.0
            for r in range(s):
                if worst > 0 and abs(c[r]) > 1e-7 * worst:
                    unit = f"{recording.unit[o]}/({recording.unit[u]})"
                    name = f"numerator_{r}" if len(inputs) * len(outputs) == 1 else f"numerator_{r}[{u},{o}]"
                    links.append(Link(len(parameters), o, u, r))
                    parameters.append(Parameter(name, unit, scale=abs(c[r])))
                    begin.append(float(c[r]))
            if direct != 0.0:
                links.append(Link(len(parameters), o, u, -1))
                parameters.append(Parameter(f"direct[{u},{o}]", "1", scale=abs(direct)))
                begin.append(float(direct))
    for k, o in enumerate(outputs):
        links.append(Link(len(parameters), o, CONSTANT, -2))
        typical = 0.01 * float(np.std(recording.outputs[o]))
        parameters.append(Parameter("y0" if len(outputs) == 1 else f"y0[{o}]", recording.unit[o], scale=typical))
        begin.append(float(m.y0[k]))

    def fixed_free(n: int) -> Mapping[str, Array]:
        y = np.zeros((n, len(outputs)))
        if np.any(m.x0 != 0):
            from tools.mismatch.twins.linear import free_response

            ad = np.ascontiguousarray(m.a if m.discrete else exponential(m.a * dt))
            for k in range(len(outputs)):
                y[:, k] = free_response(ad, np.ascontiguousarray(m.c[k]), n) @ m.x0
        return {o: y[:, k] for k, o in enumerate(outputs)}

    n_poles = len(parameters) - len(links)

    def human_of(theta: Array) -> Sequence[Human]:
        out = [Human(p.name, float(v), p.unit) for p, v in zip(parameters[:n_poles], theta, strict=False)]
        if np.all(np.abs(np.linalg.eigvals(plant_of(theta).a) - (1.0 if m.discrete else 0.0)) > 1e-9):
            for (k, i), g in np.ndenumerate(_dc_gain(plant_of(theta), links, theta, inputs, outputs, m.discrete)):
                tag = "" if len(inputs) * len(outputs) == 1 else f"[{inputs[i]},{outputs[k]}]"
                out.append(
                    Human(f"dc_gain{tag}", float(g), f"{recording.unit[outputs[k]]}/{recording.unit[inputs[i]]}")
                )
        out += [
            Human(p.name, float(v), p.unit) for p, v in zip(parameters, theta, strict=True) if p.name.startswith("y0")
        ]
        return out

    def text_of(theta: Array) -> dict[str, object]:
        return _text(plant_of(theta), links, theta, inputs, outputs, m)

    continuous = list(poles) if not m.discrete else [np.log(p + 0j) / dt for p in poles if abs(p) > 1e-12]
    slowest = min((-p.real for p in continuous), default=np.inf)
    single = len(inputs) == 1
    return DynamicTwin(
        kind="state_space",
        inputs=inputs,
        outputs=outputs,
        units=recording.unit,
        chain=("amplifier", "actuator", "mechanics", "environment", "sensor", "acquisition"),
        parameters=tuple(parameters),
        hold="discrete" if m.discrete else m.hold,
        links=tuple(links),
        groups=tuple({o: 0} for o in outputs) if s else (),
        begin=np.array(begin),
        plant_of=plant_of,
        fixed_free=fixed_free,
        human_of=human_of,
        text_of=text_of,
        restart=bool(slowest * recording.n * dt < 5.0),
        feedback_on=outputs[0] if single and s else "",
        fastest_per_s=float(np.max(np.abs(continuous))) if continuous else 0.0,
    )


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
    if a.ndim != 2 or bad or not np.all(np.isfinite(a)):
        want = " x ".join("?" if w is None else str(w) for w in shape)
        raise RecordingError(f"{where} has shape {a.shape}, expected {want} finite numbers")
    return a


def _matrices(recording: Recording) -> Matrices:
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
    if s > MAX_ORDER:
        raise RecordingError(f"{recording.path}: [twin.parameters] A is of order {s}; at most {MAX_ORDER} are handled")
    hold = text.get("hold", "linear")
    if hold not in ("zero", "linear"):
        raise RecordingError(f"{recording.path}: [twin.parameters] hold must be 'zero' or 'linear', got {hold!r}")
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
        hold,
    )


def _omega(poles: Complex, span: float) -> float:
    sizes = np.abs(poles)
    sizes = sizes[sizes > 1e-9 * (sizes.max() if sizes.size else 1.0)]
    return float(np.exp(np.mean(np.log(sizes)))) if sizes.size else 1.0 / span


def _modes(poles: Complex, discrete: bool, dt: float) -> tuple[list[tuple[str, complex]], list[complex]]:
    """Free modes ("pair" or "real") in continuous terms, and poles that stay as given (integrators, z <= 0)."""
    modes: list[tuple[str, complex]] = []
    fixed: list[complex] = []
    size = max(float(np.max(np.abs(poles))), 1e-300) if poles.size else 1.0
    for p in poles:
        z = complex(p)
        if discrete:
            if z.imag < -1e-12:
                continue
            if z.imag <= 1e-12 and (z.real <= 0 or abs(z.real - 1) < 1e-9):
                fixed.append(complex(z.real))
                continue
            c = complex(np.log(z)) / dt
            modes.append(("pair", c) if z.imag > 1e-12 else ("real", complex(c.real)))
            continue
        if z.imag < -1e-9 * size:
            continue
        if abs(z) < 1e-9 * size:
            fixed.append(0j)
        else:
            modes.append(("pair", z) if z.imag > 1e-9 * size else ("real", complex(z.real)))
    return modes, fixed


def _numerators(m: Matrices, plant: Plant) -> dict[tuple[int, int], tuple[Array, float]]:
    """Rows c with c (p - a)^-1 b equal to the given transfer function, per output and input.

    Matched at points of the complex plane away from the poles (exact for polynomials of that degree).
    """
    s = m.a.shape[0]
    out: dict[tuple[int, int], tuple[Array, float]] = {}
    size = float(np.max(np.abs(np.linalg.eigvals(plant.a)))) if s else 1.0
    points = (size or 1.0) * (1.5 + 0.5 * np.arange(s)) * np.exp(1j * (0.3 + 0.9 * np.arange(s)))
    rows = [np.linalg.solve(p * np.eye(s) - plant.a, plant.b) for p in points]
    basis = np.asarray(rows, np.complex128)
    for k in range(m.c.shape[0]):
        for i in range(m.b.shape[1]):
            want = [m.c[k] @ np.linalg.solve(p * np.eye(s) - m.a, m.b[:, i]) for p in points]
            values = np.asarray(want, np.complex128)
            if s:
                both = np.concatenate([basis.real, basis.imag])
                c = np.linalg.lstsq(both, np.concatenate([values.real, values.imag]), rcond=None)[0]
            else:
                c = np.zeros(0)
            out[k, i] = (np.asarray(c, np.float64), float(m.d[k, i]))
    return out


def _rows(
    links: Sequence[Link], theta: Array, inputs: tuple[str, ...], outputs: tuple[str, ...], s: int
) -> tuple[Array, Array, Array]:
    """C over block-diagonal companions (q, s * p), D (q, p), y0 (q,)."""
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
    out["hold"] = m.hold
    if m.discrete:
        out["discrete"] = True
    return out
