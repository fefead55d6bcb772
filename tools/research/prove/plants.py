"""The prover's own simulators of the contract's twins, and the re-fit of their base parameters.

Everything here is in the contract's units (section 2). Between recorded samples an input runs linearly
(or is held, if the scene says so); the inside is stepped on a finer grid.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.linalg import expm

from hal.arrays import Array
from tools.research.prove import guests, kernels
from tools.research.prove.plants_bench import run_bench

Signals = dict[str, Array]

AXES = ("x", "y", "z")


@dataclass
class Flow:
    """What passes along the chain, on the fine grid; effects change it in place."""

    t: Array
    drive: Signals
    context: Signals
    out: Signals
    core: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Bound:
    """One effect, all its random choices made; ``s`` is the strength handed to each hook."""

    name: str
    form: str
    on_drive: Callable[[Flow, float], None] | None = None
    on_core: Callable[[Flow, float], None] | None = None
    on_out: Callable[[Flow, float], None] | None = None
    on_clock: Callable[[Flow, float], None] | None = None
    on_samples: Callable[[Signals, float], Signals] | None = None
    with_noise: bool = False
    outputs: tuple[str, ...] = ()
    stages: tuple[str, ...] = ()
    depends: tuple[str, ...] = ()
    strength: tuple[float, float] = (1e-4, 1.0)
    truth: Callable[[float], dict[str, tuple[float, str]]] | None = None
    predictable: bool = True


@dataclass(frozen=True)
class Scene:
    """One recording situation without effects: twin, inputs, contexts, true base parameters."""

    twin: str
    t: Array
    fine: int
    inputs: Signals
    contexts: Signals
    outputs: tuple[str, ...]
    parameters: dict[str, Any]
    hidden: dict[str, float]
    excitation: str
    keep: int
    hold: str = "linear"
    memo: dict[bytes, Signals] = field(default_factory=dict[bytes, Signals], repr=False, compare=False)

    @property
    def dt(self) -> float:
        return float(self.t[1] - self.t[0])

    @property
    def fine_t(self) -> Array:
        return self.t[0] + self.dt / self.fine * np.arange((self.t.size - 1) * self.fine + 1)

    def refine(self, x: Array) -> Array:
        """Sampled signal on the fine grid: linear between samples, or held."""
        if self.fine == 1:
            return x.copy()
        if self.hold == "zero":
            return np.append(np.repeat(x[:-1], self.fine), x[-1])
        return np.interp(self.fine_t, self.t, x)


def per_output(value: Any, output: str, outputs: Sequence[str]) -> float:
    """A parameter that is one number or one per output."""
    return float(value[list(outputs).index(output)]) if isinstance(value, (list, tuple)) else float(value)


def _piezo(flow: Flow, scene: Scene, p: Mapping[str, Any]) -> None:
    flow.out["displacement"] = p["gain_um_per_V"] * flow.drive["command"] + p["offset_um"]


def _triad(prefix: str, scale: str) -> Callable[[Flow, Scene, Mapping[str, Any]], None]:
    def run(flow: Flow, scene: Scene, p: Mapping[str, Any]) -> None:
        for out in scene.outputs:
            b = per_output(p["bias_V"], out, scene.outputs)
            s = per_output(p[scale], out, scene.outputs)
            flow.out[out] = b + s * flow.drive[f"{prefix}_{out[-1]}"]

    return run


def _cluster(flow: Flow, scene: Scene, p: Mapping[str, Any]) -> None:
    f = np.stack([flow.drive[f"specific_force_{a}"] for a in AXES], axis=1)
    alpha = np.stack([flow.drive[f"_alpha_{a}"] for a in AXES], axis=1)
    for out in scene.outputs:
        where, ax = out[len("accel_") : -1], AXES.index(out[-1])
        r = np.asarray(p["positions_m"][where], float)
        flow.out[out] = (f + np.cross(alpha, r))[:, ax]


def _axis(flow: Flow, scene: Scene, p: Mapping[str, Any]) -> None:
    core = flow.core
    vec = np.zeros(20)
    vec[0], vec[1], vec[2] = p["mass"], p["damping"], p["stiffness"]
    names = [
        "k3",
        "k5",
        "cog",
        "pitch",
        "phase",
        "second",
        "kind",
        "sliding",
        "static",
        "stribeck",
        "bristle",
        "bristle_damping",
        "curve",
        "loop",
        "yield_",
        "beta",
        "gamma",
    ]
    defaults = {"pitch": 1.0, "stribeck": 1.0, "bristle": 1.0, "yield_": 1.0, "sliding": 1.0, "static": 1.0}
    for i, name in enumerate(names):
        vec[3 + i] = core.get(name, defaults.get(name, 0.0))
    force = flow.drive["force"] + p["offset_force"]
    x, v = kernels.axis(force, flow.t[1] - flow.t[0], vec, p.get("x0", 0.0), p.get("v0", 0.0))
    flow.out["position"] = x
    flow.out["velocity"] = v


def held_step(a: Array, b: Array, h: float) -> tuple[Array, Array]:
    """Discrete (A, B) for an input that is held over a step of ``h`` seconds."""
    n, m = b.shape
    block = np.zeros((n + m, n + m))
    block[:n, :n], block[:n, n:] = a * h, b * h
    e = np.asarray(expm(block), np.float64)
    return np.ascontiguousarray(e[:n, :n]), np.ascontiguousarray(e[:n, n:])


def ramp_step(a: Array, b: Array, h: float) -> tuple[Array, Array, Array]:
    """Discrete (A, B0, B1) for an input linear in a step: x(k+1) = A x + B0 u(k) + B1 u(k+1)."""
    n, m = b.shape
    block = np.zeros((n + 2 * m, n + 2 * m))
    block[:n, :n], block[:n, n : n + m] = a * h, b * h
    block[n : n + m, n + m :] = np.eye(m)
    e = np.asarray(expm(block), np.float64)
    b1 = e[:n, n + m :]
    return e[:n, :n], e[:n, n : n + m] - b1, b1


def _state_space(flow: Flow, scene: Scene, p: Mapping[str, Any]) -> None:
    a, b, c, d = (np.asarray(p[k], float) for k in "ABCD")
    x0 = np.asarray(p["x0"], float)
    u = np.stack([flow.drive[k] for k in scene.inputs], axis=1)
    h = float(flow.t[1] - flow.t[0])
    if p.get("discrete", False):
        y = kernels.linear_system(a, b, c, d, x0, u)
    elif scene.hold == "zero":
        ad, bd = held_step(a, b, h)
        y = kernels.linear_system(ad, bd, c, d, x0, u)
    else:
        ad, b0, b1 = ramp_step(a, b, h)
        # with w = x - B1 u the step needs u(k) alone
        y = kernels.linear_system(ad, b0 + ad @ b1, c, d + c @ b1, x0 - b1 @ u[0], u)
    y0 = np.broadcast_to(np.asarray(p.get("y0", 0.0), float), (len(scene.outputs),))
    for k, out in enumerate(scene.outputs):
        flow.out[out] = y[:, k] + y0[k]


def _expander(flow: Flow, scene: Scene, p: Mapping[str, Any]) -> None:
    decay = np.exp(-(flow.t[1] - flow.t[0]) / p["time_constant_s"])
    gain, none = np.array([[p["um_per_W"]]]), np.zeros((1, 1))
    power = flow.drive["power"][:, None]
    warm = kernels.linear_system(np.array([[decay]]), np.array([[1.0 - decay]]), gain, none, np.zeros(1), power)
    flow.out["expansion"] = p["offset_um"] + warm[:, 0]


def _lever(flow: Flow, scene: Scene, p: Mapping[str, Any]) -> None:
    flow.out["lift"] = p["offset_um"] + p["arm_um"] * np.sin(p["rad_per_V"] * flow.drive["drive"])


def _bench(flow: Flow, scene: Scene, p: Mapping[str, Any]) -> None:
    """One run costs more than all else here, so runs with the same inputs are kept."""
    key = b"".join(k.encode() + v.tobytes() for k, v in flow.drive.items())
    if key not in scene.memo:
        scene.memo[key] = run_bench(int(p["unit"]), flow.t, flow.drive, scene.outputs)
    flow.out.update(scene.memo[key])


CORES: dict[str, Callable[[Flow, Scene, Mapping[str, Any]], None]] = {
    "piezo_stack": _piezo,
    "accelerometer": _triad("specific_force", "scale_V_per_g"),
    "magnetometer": _triad("field", "scale_V_per_uT"),
    "accelerometer_cluster": _cluster,
    "mechanical_axis": _axis,
    "state_space": _state_space,
    guests.FMU: _expander,
    guests.USER: _lever,
    guests.INSTRUMENT: _bench,
}


def simulate(
    scene: Scene,
    effects: Sequence[tuple[Bound, float]] = (),
    parameters: Mapping[str, Any] | None = None,
    noise: Signals | None = None,
) -> Signals:
    """Outputs at the samples (contract units), ``scene.keep`` long; noise enters before sampling effects."""
    flow = Flow(
        t=scene.fine_t,
        drive={k: scene.refine(v) for k, v in scene.inputs.items()},
        context={k: scene.refine(v) for k, v in scene.contexts.items()},
        out={},
    )
    if scene.twin == "accelerometer_cluster":
        for a in AXES:
            rate = flow.drive[f"angular_rate_{a}"]
            sampled = np.gradient(scene.inputs[f"angular_rate_{a}"], scene.dt)
            flow.drive[f"_alpha_{a}"] = (
                np.interp(flow.t, scene.t, sampled) if scene.fine > 1 else np.gradient(rate, scene.dt)
            )
    p = {**scene.parameters, **scene.hidden} if parameters is None else parameters
    for bound, s in effects:
        if bound.on_drive:
            bound.on_drive(flow, s)
    for bound, s in effects:
        if bound.on_core:
            bound.on_core(flow, s)
    CORES[scene.twin](flow, scene, p)
    for hook in ("on_out", "on_clock"):
        for bound, s in effects:
            act = getattr(bound, hook)
            if act:
                act(flow, s)
    samples = {k: flow.out[k][:: scene.fine].copy() for k in scene.outputs}
    if noise is not None:
        samples = {k: v + noise[k] for k, v in samples.items()}
    for bound, s in effects:
        if bound.on_samples:
            samples = bound.on_samples(samples, s)
    return {k: v[: scene.keep] for k, v in samples.items()}


def _flat(p: Mapping[str, Any], keys: Sequence[str]) -> tuple[Array, list[tuple[str, tuple[int, ...]]]]:
    values: list[float] = []
    where: list[tuple[str, tuple[int, ...]]] = []
    for key in keys:
        arr = np.asarray(p[key], float)
        for index in np.ndindex(arr.shape):
            if key in ("A", "B", "C") and (arr[index] == 0.0 or arr[index] == 1.0):
                continue
            where.append((key, index))
            values.append(float(arr[index]))
    return np.asarray(values), where


def free_parameters(scene: Scene) -> list[str]:
    """Base parameters (and start states) that a re-fit may move."""
    if scene.twin == "piezo_stack":
        return ["gain_um_per_V", "offset_um"]
    if scene.twin == "accelerometer":
        return ["bias_V", "scale_V_per_g"]
    if scene.twin == "magnetometer":
        return ["bias_V", "scale_V_per_uT"]
    if scene.twin == "mechanical_axis":
        keys = ["mass", "damping", "offset_force", "x0", "v0"]
        return keys + (["stiffness"] if scene.parameters["stiffness"] else [])
    if scene.twin == "state_space":
        return ["A", "B", "C", "x0", "y0"]
    if scene.twin == guests.FMU:
        return ["um_per_W", "time_constant_s", "offset_um"]
    if scene.twin == guests.USER:
        return ["arm_um", "rad_per_V", "offset_um"]
    return []


def with_values(p: Mapping[str, Any], where: list[tuple[str, tuple[int, ...]]], theta: Array) -> dict[str, Any]:
    out: dict[str, Any] = dict(p)
    arrays: dict[str, Array] = {}
    for (key, index), value in zip(where, theta, strict=True):
        arrays.setdefault(key, np.array(p[key], float))[index] = value
    for key, arr in arrays.items():
        out[key] = arr.tolist() if arr.ndim else float(arr)
    return out


class Refit:
    """Least-squares re-fit of the base parameters to a residual, outputs weighted by their noise."""

    def __init__(self, scene: Scene, sigma: Mapping[str, float]) -> None:
        self.scene = scene
        self.sigma = dict(sigma)
        p = {**scene.parameters, **scene.hidden}
        # one number for all outputs is spread, so that each output may be re-fitted alone
        for key in ("bias_V", "scale_V_per_g", "scale_V_per_uT"):
            if key in p and not isinstance(p[key], (list, tuple)):
                p[key] = [p[key]] * len(scene.outputs)
        if scene.twin == "state_space":
            p["y0"] = np.broadcast_to(np.asarray(p.get("y0", 0.0), float), (len(scene.outputs),)).tolist()
        self.p = p
        self.keys = free_parameters(scene)
        self.theta, self.where = _flat(p, self.keys) if self.keys else (np.zeros(0), [])
        self.q = np.zeros((scene.keep * len(scene.outputs), 0))
        self.jac = self._jacobian(self.theta)
        if self.theta.size:
            u, sv, _ = np.linalg.svd(
                self.jac / np.maximum(np.linalg.norm(self.jac, axis=0), 1e-300), full_matrices=False
            )
            self.q = u[:, sv > 1e-7 * sv[0]]

    def _stack(self, y: Signals) -> Array:
        return np.concatenate([y[k] / self.sigma[k] for k in self.scene.outputs])

    def _base(self, theta: Array) -> Array:
        return self._stack(simulate(self.scene, parameters=with_values(self.p, self.where, theta)))

    def _jacobian(self, theta: Array) -> Array:
        cols = []
        for i in range(theta.size):
            h = 1e-5 * max(abs(theta[i]), 1e-3)
            up, down = theta.copy(), theta.copy()
            up[i] += h
            down[i] -= h
            cols.append((self._base(up) - self._base(down)) / (2 * h))
        return np.stack(cols, axis=1) if cols else np.zeros((self.q.shape[0], 0))

    def _per_output(self, r: Array) -> dict[str, float]:
        parts = r.reshape(len(self.scene.outputs), -1)
        return {k: float(np.sqrt(np.mean(v**2))) for k, v in zip(self.scene.outputs, parts, strict=True)}

    def remaining(self, delta: Signals) -> dict[str, float]:
        """rms (in noise rms) of what a linearised re-fit leaves of ``delta``, per output."""
        r = self._stack(delta)
        return self._per_output(r - self.q @ (self.q.T @ r))

    def remaining_exact(self, y: Signals, steps: int = 4) -> dict[str, float]:
        """The same by damped Gauss-Newton steps on the recording ``y`` itself."""
        target = self._stack(y)
        theta, r = self.theta.copy(), target - self._base(self.theta)
        if not theta.size:
            return self._per_output(r)
        jac = self.jac
        linear = self.scene.twin not in ("mechanical_axis", "state_space", guests.FMU, guests.USER)
        for _ in range(1 if linear else steps):
            norm = np.maximum(np.linalg.norm(jac, axis=0), 1e-300)
            step = np.linalg.lstsq(jac / norm, r, rcond=1e-7)[0] / norm
            for damp in (1.0, 0.3, 0.1):
                new = target - self._base(theta + damp * step)
                if np.all(np.isfinite(new)) and new @ new < r @ r:
                    break
            else:
                break
            gain = 1.0 - (new @ new) / (r @ r)
            theta, r = theta + damp * step, new
            if gain < 0.01 or linear:
                break
            jac = self._jacobian(theta)
        return self._per_output(r)
