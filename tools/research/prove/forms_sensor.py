"""Effects of vector sensors and of recorded context: axes, iron, temperature, supply, current, geometry."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from hal.arrays import Array
from tools.research.prove.forms_memory import Rng
from tools.research.prove.plants import AXES, Bound, Flow, Scene, per_output
from tools.research.prove.ports import added, pick_outputs, spans, zero_level

SENSOR = ("sensor", "mounting")


def prefix_of(scene: Scene) -> str:
    return "field" if scene.twin == "magnetometer" else "specific_force"


def _scale(scene: Scene, out: str) -> float:
    key = "scale_V_per_uT" if scene.twin == "magnetometer" else "scale_V_per_g"
    return per_output(scene.parameters[key], out, scene.outputs)


def _matrix_effect(name: str, form: str, scene: Scene, matrix: Array, rotation: Array | None) -> Bound:
    """Drive vector v -> v + s M v, or an exact rotation by s times a rotation vector."""
    prefix = prefix_of(scene)

    def drive(flow: Flow, s: float) -> None:
        v = np.stack([flow.drive[f"{prefix}_{a}"] for a in AXES], axis=1)
        m = np.eye(3) + s * matrix if rotation is None else Rotation.from_rotvec(s * rotation).as_matrix()
        v = v @ m.T
        for i, a in enumerate(AXES):
            flow.drive[f"{prefix}_{a}"] = v[:, i]

    return Bound(
        name,
        form,
        on_drive=drive,
        outputs=scene.outputs,
        stages=(*SENSOR, "environment"),
        depends=tuple(f"{prefix}_{a}" for a in AXES),
        strength=(1e-5, 0.6),
    )


def misalignment(rng: Rng, scene: Scene) -> Bound:
    if rng.random() < 0.6:
        vec = rng.normal(size=3)
        return _matrix_effect("misalignment", "rotation", scene, np.zeros((3, 3)), vec / np.linalg.norm(vec))
    m = rng.uniform(-1, 1, (3, 3))
    np.fill_diagonal(m, 0.0)
    return _matrix_effect("misalignment", "skewed_axes", scene, m, None)


def misalignment_of_cluster(rng: Rng, scene: Scene) -> Bound:
    """One location sits turned: each of its outputs takes a share of the other axes there."""
    places = sorted({o[len("accel_") : -1] for o in scene.outputs})
    where = str(rng.choice(places))
    turn = rng.normal(size=3)
    turn /= np.linalg.norm(turn)
    outs = tuple(o for o in scene.outputs if o[len("accel_") : -1] == where)

    def after(flow: Flow, s: float) -> None:
        f = np.stack([flow.drive[f"specific_force_{a}"] for a in AXES], axis=1)
        alpha = np.stack([flow.drive[f"_alpha_{a}"] for a in AXES], axis=1)
        here = f + np.cross(alpha, np.asarray(scene.parameters["positions_m"][where], float))
        moved = here @ Rotation.from_rotvec(s * turn).as_matrix() - here
        for out in outs:
            flow.out[out] = flow.out[out] + moved[:, AXES.index(out[-1])]

    return Bound(
        "misalignment",
        "turned_location",
        on_out=after,
        outputs=outs,
        stages=SENSOR,
        depends=tuple(f"specific_force_{a}" for a in AXES) + tuple(f"angular_rate_{a}" for a in AXES),
        strength=(1e-5, 0.5),
    )


def soft_iron(rng: Rng, scene: Scene) -> Bound:
    if rng.random() < 0.5:
        g = rng.normal(size=(3, 3))
        m = g @ g.T
        return _matrix_effect("soft_iron", "symmetric", scene, m / np.max(np.abs(m)), None)
    u = rng.normal(size=3)
    u /= np.linalg.norm(u)
    return _matrix_effect("soft_iron", "needle", scene, np.outer(u, u) * rng.choice([-1.0, 1.0]), None)


def _cross(rng: Rng, scene: Scene) -> tuple[str, str]:
    out = str(rng.choice(list(scene.outputs)))
    other = str(rng.choice([a for a in AXES if a != out[-1]]))
    return out, f"{prefix_of(scene)}_{other}"


def cross_axis_nonlinearity(rng: Rng, scene: Scene) -> Bound:
    form = str(rng.choice(["square", "square_and_quartic"]))
    out, other = _cross(rng, scene)
    c = rng.uniform(0.05, 0.2) if form != "square" else 0.0
    ref = float(np.max(np.abs(scene.inputs[other])))

    def wave(flow: Flow, key: str) -> Array:
        r = flow.drive[other] / ref
        return r**2 + c * r**4

    return added("cross_axis_nonlinearity", form, scene, (out,), wave, stages=SENSOR, depends=(other,))


def scale_factor_variation(rng: Rng, scene: Scene) -> Bound:
    form = str(rng.choice(["linear", "bent"]))
    out, other = _cross(rng, scene)
    own = f"{prefix_of(scene)}_{out[-1]}"
    ref = float(np.max(np.abs(scene.inputs[other])))
    k = _scale(scene, out)

    def after(flow: Flow, s: float) -> None:
        r = flow.drive[other] / ref
        share = r if form == "linear" else np.tanh(1.2 * r)
        flow.out[out] = flow.out[out] + s * k * flow.drive[own] * share

    return Bound(
        "scale_factor_variation",
        form,
        on_out=after,
        outputs=(out,),
        stages=SENSOR,
        depends=(other, own),
        strength=(1e-6, 0.6),
    )


def _follows(name: str, rng: Rng, scene: Scene, signal: str, stages: tuple[str, ...]) -> Bound:
    form = str(rng.choice(["bias", "gain", "both", "bias_lagged", "bias_bent"]))
    outs = pick_outputs(rng, scene, False)
    raw = scene.contexts[signal]
    mid, half = float(np.mean(raw)), float(np.max(np.abs(raw - np.mean(raw))))
    span_of = spans(scene)
    lag = np.exp(-scene.dt / scene.fine / (rng.uniform(0.02, 0.06) * (scene.t[-1] - scene.t[0])))
    g = rng.uniform(-1, 1) if form == "both" else float(form == "gain")
    bent = rng.uniform(0.05, 0.2) if form == "bias_bent" else 0.0

    def after(flow: Flow, s: float) -> None:
        r = (flow.context[signal] - mid) / half
        if form == "bias_lagged":
            r = lfilter([1 - lag], [1, -lag], r - r[0]) + r[0]
        r = r + bent * r**2
        for k in outs:
            y = flow.out[k]
            h = span_of[k].half
            if form != "gain":
                flow.out[k] = y + s * h * r
            flow.out[k] = flow.out[k] + s * g * r * (y - zero_level(scene, k))

    return Bound(name, form, on_out=after, outputs=outs, stages=stages, depends=(signal,), strength=(1e-6, 0.8))


def temperature_sensitivity(rng: Rng, scene: Scene) -> Bound:
    stages = ("sensor", "environment", "actuator", "amplifier", "mechanics", "mounting")
    return _follows("temperature_sensitivity", rng, scene, "temperature", stages)


def supply_sensitivity(rng: Rng, scene: Scene) -> Bound:
    """Ratiometric output, wholly or in part; or an offset that follows the supply."""
    if rng.random() < 0.5:
        return _follows(
            "supply_sensitivity", rng, scene, "supply", ("sensor", "environment", "amplifier", "acquisition")
        )
    raw = scene.contexts["supply"]
    mid = float(np.mean(raw))

    def after(flow: Flow, s: float) -> None:
        ratio = (flow.context["supply"] / mid) ** s
        for k in scene.outputs:
            flow.out[k] = flow.out[k] * ratio

    return Bound(
        "supply_sensitivity",
        "ratiometric",
        on_out=after,
        outputs=scene.outputs,
        stages=("sensor", "environment", "amplifier", "acquisition"),
        depends=("supply",),
        strength=(1e-5, 2.0),
    )


def current_coupling(rng: Rng, scene: Scene) -> Bound:
    signal = "actuator_current" if "actuator_current" in scene.contexts else "current"
    outs = scene.outputs if rng.random() < 0.6 else pick_outputs(rng, scene, True)
    raw = scene.contexts[signal]
    half = float(np.max(np.abs(raw)))
    direction = dict(zip(outs, rng.uniform(0.3, 1.0, len(outs)) * rng.choice([-1, 1], len(outs)), strict=True))

    def wave(flow: Flow, key: str) -> Array:
        return direction[key] * flow.context[signal] / half

    return added(
        "current_coupling",
        "linear",
        scene,
        outs,
        wave,
        stages=("environment", "sensor", "actuator", "mounting"),
        depends=(signal,),
    )


def centripetal_acceleration(rng: Rng, scene: Scene) -> Bound:
    def after(flow: Flow, s: float) -> None:
        w = np.stack([flow.drive[f"angular_rate_{a}"] for a in AXES], axis=1)
        for out in scene.outputs:
            r = np.asarray(scene.parameters["positions_m"][out[len("accel_") : -1]], float)
            flow.out[out] = flow.out[out] + s * np.cross(w, np.cross(w, r))[:, AXES.index(out[-1])]

    return Bound(
        "centripetal_acceleration",
        "exact",
        on_out=after,
        outputs=scene.outputs,
        stages=("mechanics", "mounting", "sensor"),
        depends=tuple(f"angular_rate_{a}" for a in AXES),
        strength=(1.0, 1.0),
    )


def sensor_position_error(rng: Rng, scene: Scene) -> Bound:
    places = sorted({o[len("accel_") : -1] for o in scene.outputs})
    moved = [str(rng.choice(places))] if rng.random() < 0.6 else places
    offset = {k: rng.normal(size=3) for k in moved}
    # a move along the sensed axis of a one-axis location cannot be seen
    outs = tuple(o for o in scene.outputs if o[len("accel_") : -1] in moved)

    def after(flow: Flow, s: float) -> None:
        alpha = np.stack([flow.drive[f"_alpha_{a}"] for a in AXES], axis=1)
        for out in outs:
            d = s * offset[out[len("accel_") : -1]]
            flow.out[out] = flow.out[out] + np.cross(alpha, d)[:, AXES.index(out[-1])]

    return Bound(
        "sensor_position_error",
        "moved",
        on_out=after,
        outputs=outs,
        stages=("mounting", "mechanics", "sensor"),
        depends=tuple(f"angular_rate_{a}" for a in AXES),
        strength=(1e-6, 0.08),
    )
