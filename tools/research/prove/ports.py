"""Where an effect sits: wiring of one-signal shapes to a drive or to outputs of a scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hal.arrays import Array
from tools.research.prove.forms_memory import SHAPES, Rng, lti
from tools.research.prove.plants import Bound, Flow, Scene, per_output, simulate

STAGES_DRIVE = ("amplifier", "actuator", "mechanics", "acquisition")
STAGES_OUT = ("sensor", "mechanics", "mounting", "acquisition", "actuator")
CENTRED_AT_ZERO = ("ac_coupling", "dead_zone")


@dataclass(frozen=True)
class Span:
    """How a signal is normalised: (x - mid) / half."""

    mid: float
    half: float

    @staticmethod
    def of(x: Array, zero: bool = False) -> Span:
        if zero:
            return Span(0.0, max(float(np.max(np.abs(x))), 1e-12))
        low, high = float(np.min(x)), float(np.max(x))
        return Span(0.5 * (low + high), max(0.5 * (high - low), 1e-12))


def spans(scene: Scene) -> dict[str, Span]:
    """Normalisation of all outputs, from the scene without effects."""
    return {k: Span.of(v) for k, v in simulate(scene).items()}


def zero_level(scene: Scene, key: str) -> float:
    """The output at zero input, where a gain error has no effect."""
    p = scene.parameters
    if "bias_V" in p:
        return per_output(p["bias_V"], key, scene.outputs)
    return float(p.get("offset_um", 0.0)) if scene.twin == "piezo_stack" else 0.0


def pick_outputs(rng: Rng, scene: Scene, one: bool) -> tuple[str, ...]:
    if one or len(scene.outputs) == 1 or rng.random() < 0.5:
        return (str(rng.choice(list(scene.outputs))),)
    return scene.outputs


def main_drive(scene: Scene) -> str:
    return "force" if "force" in scene.inputs else next(iter(scene.inputs))


def shaped(name: str, rng: Rng, scene: Scene, where: str) -> Bound:
    """A one-signal effect at the drive ('drive'), at outputs ('out', 'out_all', 'one_out') or at 'either' end."""
    if where == "either":
        where = "drive" if rng.random() < 0.6 else "one_out"
    shape = SHAPES[name](rng)
    zero = name in CENTRED_AT_ZERO
    if where == "drive":
        key = main_drive(scene)
        span = Span.of(scene.inputs[key], zero)

        def drive(flow: Flow, s: float) -> None:
            dt = float(flow.t[1] - flow.t[0])
            x = (flow.drive[key] - span.mid) / span.half
            flow.drive[key] = span.mid + span.half * shape.transform(x, dt, s)

        truth = shape.truth

        def in_drive_unit(s: float) -> dict[str, tuple[float, str]]:
            assert truth is not None
            return {k: (v * span.half, "drive") if u == "norm" else (v, u) for k, (v, u) in truth(s).items()}

        return Bound(
            name,
            shape.form,
            on_drive=drive,
            outputs=scene.outputs,
            stages=STAGES_DRIVE,
            depends=(key, *scene.outputs),
            strength=shape.strength,
            truth=in_drive_unit if truth else None,
        )
    outs = scene.outputs if where == "out_all" else pick_outputs(rng, scene, one=where == "one_out")
    outs = scene.outputs if where == "out_all" else pick_outputs(rng, scene, one=where == "one_out")
    base = simulate(scene)
    span_of = {k: Span.of(base[k], zero) for k in outs}
    if name == "dead_zone":
        span_of = {
            k: Span(zero_level(scene, k), max(float(np.max(np.abs(base[k] - zero_level(scene, k)))), 1e-12))
            for k in outs
        }

    def out(flow: Flow, s: float) -> None:
        dt = float(flow.t[1] - flow.t[0])
        for k in outs:
            sp = span_of[k]
            flow.out[k] = sp.mid + sp.half * shape.transform((flow.out[k] - sp.mid) / sp.half, dt, s)

    return Bound(
        name,
        shape.form,
        on_out=out,
        outputs=outs,
        stages=(*STAGES_OUT, "amplifier"),
        depends=tuple(scene.inputs) + scene.outputs,
        strength=shape.strength,
        truth=shape.truth if name not in ("backlash",) else None,
    )


def same_place(name: str, other: Bound) -> Bound:
    """A plain 'dead_time' or 'first_order_lag' where ``other`` sits: could one pass for the other?"""

    def late(x: Array, dt: float, s: float) -> Array:
        if name == "first_order_lag":
            return lti([1.0], [s, 1.0], x - x[0], dt) + x[0]
        i = np.arange(x.size, dtype=float)
        return np.interp(i - s / dt, i, x)

    def drive(flow: Flow, s: float) -> None:
        key = next(iter(flow.drive)) if "force" not in flow.drive else "force"
        flow.drive[key] = late(flow.drive[key], float(flow.t[1] - flow.t[0]), s)

    def out(flow: Flow, s: float) -> None:
        for k in other.outputs:
            flow.out[k] = late(flow.out[k], float(flow.t[1] - flow.t[0]), s)

    at_drive = other.on_drive is not None
    return Bound(
        name, "plain", on_drive=drive if at_drive else None, on_out=None if at_drive else out, strength=(1e-6, 0.5)
    )


def added(
    name: str,
    form: str,
    scene: Scene,
    outs: tuple[str, ...],
    wave: Callable[[Flow, str], Array],
    *,
    stages: tuple[str, ...],
    depends: tuple[str, ...] = ("time",),
    truth: Callable[[float], dict[str, tuple[float, str]]] | None = None,
    predictable: bool = True,
) -> Bound:
    """out += s * half * wave; ``wave`` must not depend on s."""
    span_of = spans(scene)
    kept: dict[str, Array] = {}

    def out(flow: Flow, s: float) -> None:
        for k in outs:
            if k not in kept:
                kept[k] = wave(flow, k)
            flow.out[k] = flow.out[k] + s * span_of[k].half * kept[k]

    return Bound(
        name,
        form,
        on_out=out,
        outputs=outs,
        stages=stages,
        depends=depends,
        strength=(1e-6, 1e3),
        truth=truth,
        predictable=predictable,
    )
