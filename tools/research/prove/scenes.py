"""Scenes: a twin with true base parameters, an excitation, recorded contexts; no effects yet."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hal.arrays import Array
from tools.research.prove import excite, guests
from tools.research.prove.catalog import BODY, SCALAR_ALL, VECTOR_ALL
from tools.research.prove.forms_memory import Rng
from tools.research.prove.plants import AXES, Scene, Signals, held_step

# context signals of the contract, section 2, with a level and a swing (contract unit)
CONTEXTS: dict[str, dict[str, tuple[float, float]]] = {
    "piezo_stack": {"temperature": (25.0, 6.0), "load": (8.0, 5.0)},
    "accelerometer": {"temperature": (25.0, 8.0), "supply": (5.0, 0.15)},
    "magnetometer": {"temperature": (25.0, 8.0), "actuator_current": (0.05, 0.6)},
    "accelerometer_cluster": {"temperature": (25.0, 8.0)},
    "mechanical_axis": {"temperature": (25.0, 10.0), "current": (0.2, 1.5)},
    "state_space": {"temperature": (25.0, 10.0), "supply": (12.0, 0.5), "pressure": (1.0e5, 3.0e3)},
    guests.FMU: {"temperature": (25.0, 10.0), "supply": (12.0, 0.5), "pressure": (1.0e5, 3.0e3)},
    guests.USER: {"temperature": (25.0, 10.0), "supply": (12.0, 0.5), "pressure": (1.0e5, 3.0e3)},
    guests.INSTRUMENT: {"pressure": (1.0e5, 3.0e3), "humidity": (0.45, 0.2)},
}
# further names that only an effect outside the vocabulary may follow
STRANGERS: dict[str, tuple[float, float]] = {
    "pressure": (1.0e5, 4.0e3),
    "humidity": (0.45, 0.2),
    "load": (8.0, 5.0),
}
UNITS = {
    "temperature": "degC",
    "load": "N",
    "supply": "V",
    "actuator_current": "A",
    "current": "A",
    "pressure": "Pa",
    "humidity": "1",
}


@dataclass(frozen=True)
class Wish:
    """What a case asks of its scene."""

    twin: str
    excitation: str
    context: str | None = None
    decoys: tuple[str, ...] = ()
    all_axes: bool = False
    least_s: float = 0.0
    fast_only: bool = False
    bipolar: bool = False
    max_samples: int = 24_000


def _timing(rng: Rng, wish: Wish) -> tuple[float, int]:
    """(rate_hz, samples)."""
    if wish.excitation.startswith("slow"):
        return 1.0, int(min(rng.uniform(1.0, 8.0) * 3600.0, wish.max_samples))
    low = max(10.0, wish.least_s)
    if wish.twin == guests.FMU:  # every sample of every run is a call of somebody else's program
        rate = 125.0 if wish.fast_only else 50.0
        return rate, int(rate * max(rng.uniform(8.0, 12.0), 1.05 * wish.least_s))
    if wish.twin == guests.INSTRUMENT:  # a run costs 50 us a millisecond
        return 1000.0, int(rng.uniform(800.0, 1200.0))
    rates = (200.0, 250.0, 400.0, 500.0, 1000.0)
    rate = float(rng.choice([r for r in rates if r * low <= wish.max_samples] or rates[:1]))
    longest = max(min(120.0, wish.max_samples / rate), low * 1.05)
    return rate, int(rate * np.exp(rng.uniform(np.log(low), np.log(longest))))


def _contexts(rng: Rng, wish: Wish, t: Array) -> Signals:
    out: Signals = {}
    names = ([wish.context] if wish.context else []) + list(wish.decoys)
    kinds = rng.permutation(["ambient", "cycled", "steps", "ripple"])
    for name, kind in zip(names, kinds, strict=False):
        level, swing = {**STRANGERS, **CONTEXTS[wish.twin]}[name]
        out[name] = level + swing * rng.uniform(0.5, 1.0) * excite.context(rng, str(kind), t)
    return out


def _command(rng: Rng, wish: Wish, t: Array) -> tuple[Signals, dict[str, Any]]:
    x = excite.scalar(rng, wish.excitation, t)
    if wish.bipolar or rng.random() < 0.3:
        u = x * rng.uniform(10.0, 60.0)
    else:
        half = rng.uniform(15.0, 48.0)
        u = 50.0 + half * x
    return {"command": u}, {"gain_um_per_V": rng.uniform(0.05, 0.3), "offset_um": rng.uniform(-3, 3)}


def _gravity(rng: Rng, wish: Wish, t: Array) -> Array:
    kind = wish.excitation
    if kind in ("rotary", "tumble", "slow3"):
        v = excite.turning(rng, kind, t, np.array([0.0, 0.0, 1.0]))
        if kind == "tumble":
            v = v + 0.05 * excite.smooth_vector(rng, t, (0.5, 4.0), 5)[0]
        return v
    still = excite.turning(rng, "shake3", t, np.array([0.0, 0.0, 1.0]))
    return still + rng.uniform(0.2, 0.9) * excite.shaking(rng, kind, t)


def _accelerometer(rng: Rng, wish: Wish, t: Array) -> tuple[Signals, tuple[str, ...], dict[str, Any]]:
    f = _gravity(rng, wish, t)
    axes = AXES if wish.all_axes or rng.random() < 0.7 else (str(rng.choice(AXES)),)
    inputs = {f"specific_force_{a}": f[:, i] for i, a in enumerate(AXES) if a in axes}
    per_axis = rng.random() < 0.6
    scale: Any = rng.uniform(0.2, 1.2)
    bias: Any = rng.uniform(1.4, 2.6)
    if per_axis:
        scale = [scale * rng.uniform(0.95, 1.05) for _ in axes]
        bias = [bias + rng.uniform(-0.05, 0.05) for _ in axes]
    return inputs, tuple(f"voltage_{a}" for a in axes), {"bias_V": bias, "scale_V_per_g": scale}


def _magnetometer(rng: Rng, wish: Wish, t: Array) -> tuple[Signals, tuple[str, ...], dict[str, Any]]:
    dip = np.deg2rad(rng.uniform(20, 70))
    world = rng.uniform(30, 60) * np.array([np.cos(dip), 0.0, -np.sin(dip)])
    kind = wish.excitation if wish.excitation in ("rotary", "tumble", "slow3") else "tumble"
    b = excite.turning(rng, kind, t, world)
    if wish.fast_only:
        b = b + 8.0 * excite.smooth_vector(rng, t, (0.5, 9.0), 6)[0]
    axes = AXES if wish.all_axes or rng.random() < 0.8 else (str(rng.choice(AXES)),)
    inputs = {f"field_{a}": b[:, i] for i, a in enumerate(AXES) if a in axes}
    scale: Any = 0.01 * rng.uniform(0.5, 2.0)
    bias: Any = 2.5 + rng.uniform(-0.1, 0.1)
    if rng.random() < 0.5:
        scale = [scale * rng.uniform(0.95, 1.05) for _ in axes]
        bias = [bias + rng.uniform(-0.05, 0.05) for _ in axes]
    return inputs, tuple(f"voltage_{a}" for a in axes), {"bias_V": bias, "scale_V_per_uT": scale}


def _cluster(rng: Rng, wish: Wish, t: Array) -> tuple[Signals, tuple[str, ...], dict[str, Any]]:
    if wish.excitation == "swing":
        w, _ = excite.smooth_vector(rng, t, (0.6, 3.0), 3)
        w = w * rng.uniform(1.5, 4.0)
        f = 9.8 * excite.turning(rng, "shake3", t, np.array([0, 0, 1.0])) + excite.smooth_vector(rng, t, (0.3, 3), 4)[0]
    elif wish.excitation == "tremor6":
        w = 0.3 * excite.smooth_vector(rng, t, (8.0, 12.0), 6)[0] + 0.2 * excite.smooth_vector(rng, t, (0.1, 0.8), 4)[0]
        f = 9.8 * excite.turning(rng, "shake3", t, np.array([0, 0, 1.0]))
        f = f + 0.15 * excite.smooth_vector(rng, t, (8.0, 12.0), 6)[0]
    else:
        w = rng.uniform(0.3, 1.0) * excite.smooth_vector(rng, t, (1.0, 12.0), 8)[0]
        f = 9.8 * excite.turning(rng, "shake3", t, np.array([0, 0, 1.0]))
        f = f + 0.8 * excite.smooth_vector(rng, t, (1.0, 15.0), 8)[0]
    places = {str(k + 1): rng.uniform(-0.12, 0.12, 3).round(4).tolist() for k in range(int(rng.integers(2, 4)))}
    outs: list[str] = []
    for k in places:
        count = 3 if rng.random() < 0.4 else 2
        outs += [f"accel_{k}{a}" for a in sorted(rng.permutation(list(AXES))[:count])]
    inputs = {f"specific_force_{a}": f[:, i] for i, a in enumerate(AXES)}
    inputs |= {f"angular_rate_{a}": w[:, i] for i, a in enumerate(AXES)}
    return inputs, tuple(outs), {"positions_m": places}


def _axis(rng: Rng, wish: Wish, t: Array) -> tuple[Signals, tuple[str, ...], dict[str, Any], dict[str, float]]:
    mass = 10 ** rng.uniform(-0.7, 1.7)
    free = rng.random() < 0.2
    f0 = 0.0 if free else rng.uniform(1.0, 9.0)
    k = mass * (2 * np.pi * f0) ** 2
    c = mass / rng.uniform(0.05, 0.4) if free else 2 * rng.uniform(0.08, 0.6) * mass * 2 * np.pi * f0
    x = excite.scalar(rng, wish.excitation, t)
    force = x * mass * 10 ** rng.uniform(-0.5, 1.0)
    both = rng.random() < 0.3
    outs: tuple[str, ...] = ("velocity",) if free else ("position",)
    outs = ("position", "velocity") if both else outs
    offset = 0.0 if free or rng.random() < 0.4 else float(0.1 * rng.uniform(-1, 1) * np.max(np.abs(force)))
    p = {"mass": mass, "damping": c, "stiffness": k, "offset_force": offset}
    start = {"x0": 0.0, "v0": 0.0}
    if k and rng.random() < 0.5:
        start["x0"] = float((force[0] + offset) / k)
    return {"force": force}, outs, p, start


def _state_space(rng: Rng, wish: Wish, t: Array) -> tuple[Signals, tuple[str, ...], dict[str, Any]]:
    discrete = rng.random() < 0.3
    w, z = 2 * np.pi * rng.uniform(2.0, 12.0), rng.uniform(0.15, 0.8)
    g = 10 ** rng.uniform(-0.5, 0.7)
    form = str(rng.choice(["second", "third", "two_outputs", "first"]))
    if form == "first":
        a, b, c, d = [[-w]], [[w]], [[g]], [[0.0]]
    elif form == "third":
        q = 2 * np.pi * rng.uniform(3.0, 15.0)
        a = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-w * w * q, -w * w - 2 * z * w * q, -2 * z * w - q]]
        b, c, d = [[0.0], [0.0], [1.0]], [[g * w * w * q, 0.0, 0.0]], [[0.0]]
    else:
        a, b = [[0.0, 1.0], [-w * w, -2 * z * w]], [[0.0], [w * w]]
        c = [[g, 0.0]] if form == "second" else [[g, 0.0], [0.0, g / w]]
        d = [[0.0]] * len(c)
    if discrete:
        ad, bd = held_step(np.asarray(a), np.asarray(b), float(t[1] - t[0]))
        a, b = ad.tolist(), bd.tolist()
    u = excite.scalar(rng, wish.excitation, t) * rng.uniform(0.5, 5.0)
    outs = ("y",) if len(c) == 1 else ("angle", "speed")
    p: dict[str, Any] = {"A": a, "B": b, "C": c, "D": d, "x0": [0.0] * len(a)}
    p["y0"] = [float(v) for v in rng.uniform(-0.2, 0.2, len(c))] if rng.random() < 0.5 else [0.0] * len(c)
    if discrete:
        p["discrete"] = True
    return {"drive": u}, outs, p


def _expander(rng: Rng, wish: Wish, t: Array) -> tuple[Signals, tuple[str, ...], dict[str, Any]]:
    power = rng.uniform(2.0, 8.0) * (1.0 + 0.9 * excite.scalar(rng, wish.excitation, t))
    p = {"um_per_W": rng.uniform(0.5, 4.0), "time_constant_s": rng.uniform(0.03, 0.4), "offset_um": rng.uniform(-3, 3)}
    return {"power": power}, ("expansion",), p


def _lever(rng: Rng, wish: Wish, t: Array) -> tuple[Signals, tuple[str, ...], dict[str, Any]]:
    u = rng.uniform(1.0, 5.0) * excite.scalar(rng, wish.excitation, t)
    turn = rng.uniform(0.5, 1.2) / float(np.max(np.abs(u)))
    return {"drive": u}, ("lift",), {"arm_um": rng.uniform(50, 500), "rad_per_V": turn, "offset_um": rng.uniform(-9, 9)}


def _bench(rng: Rng, wish: Wish, t: Array) -> tuple[Signals, tuple[str, ...], dict[str, Any]]:
    """Commands move the tip; in half of them a hand does too, and the accelerometers see it."""
    inputs = {"command_1": 50.0 + rng.uniform(15.0, 40.0) * excite.scalar(rng, wish.excitation, t)}
    if rng.random() < 0.5:
        inputs["path_x"] = 1e-4 * rng.uniform(0.5, 3.0) * excite.scalar(rng, "tremor", t)
        return inputs, ("volts_0", "tip_x"), {"unit": int(rng.integers(1, 9))}
    return inputs, ("tip_x", "tip_y"), {"unit": int(rng.integers(1, 9))}


def build(rng: Rng, wish: Wish) -> Scene:
    """Draw a scene. The arrays are longer than the recording, so that clocks can run and samples get lost."""
    rate, keep = _timing(rng, wish)
    n = keep + max(int(0.06 * keep), 40)
    t = np.arange(n) / rate
    hidden: dict[str, float] = {}
    hold = "linear"
    inside = 2000.0 if wish.twin == "accelerometer_cluster" else 4000.0
    fine = max(1, round(inside / rate)) if rate > 1.0 else 1
    if wish.twin == "piezo_stack":
        inputs, p = _command(rng, wish, t)
        outs: tuple[str, ...] = ("displacement",)
    elif wish.twin == "accelerometer":
        inputs, outs, p = _accelerometer(rng, wish, t)
    elif wish.twin == "magnetometer":
        inputs, outs, p = _magnetometer(rng, wish, t)
    elif wish.twin == "accelerometer_cluster":
        inputs, outs, p = _cluster(rng, wish, t)
    elif wish.twin == "mechanical_axis":
        inputs, outs, p, hidden = _axis(rng, wish, t)
    elif wish.twin == guests.FMU:
        inputs, outs, p = _expander(rng, wish, t)
        hold = "zero"
    elif wish.twin == guests.USER:
        inputs, outs, p = _lever(rng, wish, t)
    elif wish.twin == guests.INSTRUMENT:
        inputs, outs, p = _bench(rng, wish, t)
        fine = 1
    else:
        inputs, outs, p = _state_space(rng, wish, t)
        if p.get("discrete"):
            fine = 1
        elif rng.random() < 0.25:
            hold = "zero"
            p["hold"] = "zero"
    return Scene(
        twin=wish.twin,
        t=t,
        fine=fine,
        inputs=inputs,
        contexts=_contexts(rng, wish, t),
        outputs=outs,
        parameters=p,
        hidden=hidden,
        excitation=wish.excitation,
        keep=keep,
        hold=hold,
    )


def excitations_of(twin: str) -> tuple[str, ...]:
    if twin in ("accelerometer", "magnetometer"):
        if twin == "magnetometer":
            return ("rotary", "tumble", "slow3")
        return VECTOR_ALL
    if twin == "accelerometer_cluster":
        return BODY
    if twin == "piezo_stack":
        return SCALAR_ALL
    return tuple(e for e in SCALAR_ALL if e not in ("slow", "sine"))
