"""Mechanical axis: m x'' + c x' + k x = F + offset, for one translation or rotation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.signal import bilinear, lfilter

from sim_devices.physics.effect import Array, Human, Parameter
from tools.errors import RecordingError
from tools.mismatch.keys import PARAMETERS, names
from tools.mismatch.recording import Recording
from tools.mismatch.twins.dynamic import CONSTANT, DynamicTwin, Link, Plant
from tools.mismatch.twins.holds import holds_text, read_holds
from tools.numbers import is_finite_number

_NAMES = names(PARAMETERS["mechanical_axis"])


def axis_twin(recording: Recording) -> DynamicTwin:
    """Build the twin; theta = damping/mass, [stiffness/mass with a spring], 1/mass, offset/mass."""
    text = recording.twin.parameters
    for key in text:
        if key not in _NAMES:
            raise RecordingError(
                f"{recording.path}: [twin.parameters] '{key}' is not a parameter of mechanical_axis;"
                f" known: {', '.join(_NAMES)}"
            )
    holds = read_holds(recording)
    given = {k: _number(recording, k, text.get(k)) for k in _NAMES[:4]}
    if given["mass"] is not None and given["mass"] <= 0:
        raise RecordingError(f"{recording.path}: [twin.parameters] mass must be positive, got {given['mass']}")
    sprung = bool(given["stiffness"])
    mass, damping, stiffness, offset = _begin(recording, given, sprung)
    source = next(iter(recording.inputs))
    position_unit = recording.unit[next(iter(recording.outputs))].removesuffix("/s")
    f = recording.unit[source]
    outputs = tuple(recording.outputs)
    row = {"position": 0, "velocity": 1}
    dm = max(damping / mass, 1e-6)
    parameters = [Parameter("damping_per_mass", "1/s", 0.0, np.inf, scale=dm)]
    begin = [damping / mass]
    if sprung:
        parameters.append(Parameter("stiffness_per_mass", "1/s^2", 0.0, np.inf, scale=stiffness / mass))
        begin.append(stiffness / mass)
    k = len(parameters)
    typical = float(np.std(recording.inputs[source])) or 1.0
    parameters.append(Parameter("inverse_mass", f"{position_unit}/(s^2 {f})", scale=1 / mass))
    parameters.append(Parameter("offset_per_mass", f"{position_unit}/s^2", scale=0.01 * typical / mass))
    begin += [1 / mass, offset / mass]
    links = [Link(k, o, source, row[o]) for o in outputs] + [Link(k + 1, o, CONSTANT, row[o]) for o in outputs]

    def plant_of(theta: Array) -> Plant:
        stiff = theta[1] if sprung else 0.0
        return Plant(np.array([[0.0, 1.0], [-stiff, -theta[0]]]), np.array([0.0, 1.0]))

    per = f"{f} s/{position_unit}"

    def human_of(theta: Array) -> Sequence[Human]:
        m = 1.0 / theta[k]
        out = [Human("mass", m, f"{f} s^2/{position_unit}"), Human("damping", theta[0] * m, per)]
        if sprung:
            out.append(Human("stiffness", theta[1] * m, f"{f}/{position_unit}"))
        return [*out, Human("offset_force", theta[k + 1] * m, f)]

    def text_of(theta: Array) -> dict[str, object]:
        out: dict[str, object] = {h.name: float(h.value) for h in human_of(theta)}
        if "hold" in text:
            out["hold"] = holds_text(holds)
        return out

    def motion_of(x: Array, v: Array, u: Array) -> Array:
        return np.column_stack([-v, *([-x] if sprung else []), u, np.ones(u.size)])

    rates = np.roots([1.0, damping / mass, stiffness / mass])
    span = recording.n * recording.dt
    return DynamicTwin(
        kind="mechanical_axis",
        inputs=(source,),
        outputs=outputs,
        units=recording.unit,
        chain=("amplifier", "actuator", "mechanics", "environment", "sensor", "acquisition"),
        parameters=tuple(parameters),
        holds=holds,
        links=tuple(links),
        groups=({o: row[o] for o in outputs},),
        begin=np.array(begin),
        plant_of=plant_of,
        fixed_free=None,
        human_of=human_of,
        text_of=text_of,
        restart=bool(np.min(-rates.real) * span < 20.0),
        feedback_on="position" if "position" in outputs else "velocity",
        counted="" if "position" in outputs else "rest" if sprung else "start",
        motion_of=motion_of,
        fastest_per_s=float(np.max(np.abs(rates))) if sprung else float(damping / mass),
    )


def _number(recording: Recording, key: str, value: object) -> float | None:
    if value is None:
        return None
    if not is_finite_number(value):
        raise RecordingError(f"{recording.path}: [twin.parameters] {key} must be a finite number, got {value!r}")
    return float(value)


def _begin(recording: Recording, given: dict[str, float | None], sprung: bool) -> tuple[float, float, float, float]:
    """Return the given values; an offset that is not named is absent.

    Missing mass and damping are estimated by regression on filtered derivatives (state variable filter).
    """
    known = {k: v for k, v in given.items() if v is not None}
    if not sprung:
        known["stiffness"] = 0.0
    known.setdefault("offset_force", 0.0)
    missing = [k for k in ("mass", "damping", "stiffness", "offset_force") if k not in known]
    if missing:
        y = recording.outputs.get("position")
        derivative = y is None
        signal = next(iter(recording.outputs.values())) if y is None else y
        u = next(iter(recording.inputs.values()))
        terms = _filtered(u, signal, derivative, recording.dt)
        names = ("mass", "damping", "stiffness", "offset_force")
        left = terms[:, 4].copy()
        for k, v in known.items():
            left -= v * terms[:, names.index(k)]
        found = np.linalg.lstsq(terms[:, [names.index(k) for k in missing]], left, rcond=None)[0]
        known.update(zip(missing, found.tolist(), strict=True))
        if known["mass"] <= 0:
            known["mass"] = float(abs(known["mass"])) or 1.0
        known["damping"] = max(known["damping"], 0.0)
    return known["mass"], known["damping"], known["stiffness"], known["offset_force"]


def _filtered(u: Array, y: Array, velocity: bool, dt: float) -> Array:
    """Return the columns acceleration, velocity, position, -1 and force, all filtered by a third-order low-pass."""
    spectrum = np.abs(np.fft.rfft(u - u.mean())) ** 2
    cut = np.searchsorted(np.cumsum(spectrum), 0.98 * spectrum.sum())
    corner = 2 * np.pi * min(max(cut / (u.size * dt), 5 / (u.size * dt)), 0.1 / dt)
    den = [float(v) / corner**3 for v in np.poly([-corner] * 3)]
    cols: list[Array] = []
    for order in (2, 1, 0):
        power = order - 1 if velocity else order
        if power < 0:
            cols.append(np.cumsum(cols[-1]) * dt)
            continue
        num = [1.0] + [0.0] * power
        cols.append(_filter(num, den, dt, y - y[0]))
    cols.append(-np.ones(u.size))
    cols.append(_filter([1.0], den, dt, u))
    skip = min(u.size // 4, int(10 / (corner * dt)))
    return np.stack(cols, axis=1)[skip:]


def _filter(num: list[float], den: list[float], dt: float, x: Array) -> Array:
    b, a = bilinear(num, den, fs=1 / dt)
    return np.asarray(lfilter(b, a, x), np.float64)
