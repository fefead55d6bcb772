"""Effects inside a driven axis: friction, springs, cogging, a hysteretic spring."""

from __future__ import annotations

import numpy as np

from tools.research.prove.forms_memory import Rng
from tools.research.prove.plants import Bound, Flow, Scene, simulate

MECHANICS = ("mechanics", "actuator")


def _motion(scene: Scene) -> tuple[float, float, float]:
    """(largest |x|, rms of v, largest |force|) of the scene without effects."""
    both = simulate(Scene(**{**scene.__dict__, "outputs": ("position", "velocity")}))
    x = both["position"]
    return (
        float(np.max(np.abs(x))),
        float(np.std(both["velocity"])),
        float(np.max(np.abs(scene.inputs["force"]))),
    )


def _core(
    name: str,
    form: str,
    scene: Scene,
    values: dict[str, float],
    scaled: dict[str, float],
    top: float,
    truth: dict[str, str] | None = None,
) -> Bound:
    """``values`` go to the core as they are, ``scaled`` times the strength."""

    def core(flow: Flow, s: float) -> None:
        flow.core.update(values)
        flow.core.update({k: s * v for k, v in scaled.items()})

    def figures(s: float) -> dict[str, tuple[float, str]]:
        assert truth is not None
        both = {**values, **{k: s * v for k, v in scaled.items()}}
        return {k: (both[k], unit) for k, unit in truth.items()}

    return Bound(
        name,
        form,
        on_core=core,
        outputs=scene.outputs,
        stages=MECHANICS,
        depends=("force", "position", "velocity"),
        strength=(1e-6, top),
        truth=figures if truth else None,
    )


def coulomb_friction(rng: Rng, scene: Scene) -> Bound:
    x, v, f = _motion(scene)
    form = str(rng.choice(["tanh", "karnopp", "lugre", "dahl"]))
    kind = {"tanh": 1.0, "karnopp": 2.0, "lugre": 3.0, "dahl": 4.0}[form]
    values = {"kind": kind, "stribeck": v * (0.02 if form == "tanh" else 0.05)}
    scaled = {"sliding": f, "static": f}
    if form in ("lugre", "dahl"):
        # the bristles give way after a small share of the travel
        scaled["bristle"] = f / (x * rng.uniform(0.002, 0.01))
        values["bristle_damping"] = 0.0
    return _core("coulomb_friction", form, scene, values, scaled, 0.5, {"sliding": "N"})


def stribeck_friction(rng: Rng, scene: Scene) -> Bound:
    x, v, f = _motion(scene)
    form = str(rng.choice(["karnopp_exponential", "karnopp_lorentzian", "lugre_exponential", "lugre_lorentzian"]))
    values = {
        "kind": 2.0 if form.startswith("karnopp") else 3.0,
        "stribeck": v * rng.uniform(0.15, 0.5),
        "curve": 1.0 if form.endswith("lorentzian") else 0.0,
        "bristle_damping": 0.0,
    }
    scaled = {"sliding": f, "static": f * rng.uniform(1.6, 3.0)}
    scaled["bristle"] = f / (x * rng.uniform(0.002, 0.01))
    return _core("stribeck_friction", form, scene, values, scaled, 0.4, {"sliding": "N", "static": "N"})


def cubic_stiffness(rng: Rng, scene: Scene) -> Bound:
    x, _, f = _motion(scene)
    sign = 1.0 if rng.random() < 0.7 else -1.0
    k = max(scene.parameters["stiffness"], f / x)
    fifth = rng.uniform(0.0, 0.12)
    form = "hardening" if sign > 0 else "softening"
    top = 3.0 if sign > 0 else 0.35
    return _core("cubic_stiffness", form, scene, {}, {"k3": sign * k / x**2, "k5": sign * fifth * k / x**4}, top)


def cogging(rng: Rng, scene: Scene) -> Bound:
    x, _, f = _motion(scene)
    pitch = x * rng.uniform(0.12, 0.5)
    form = str(rng.choice(["sine", "with_second_harmonic"]))
    values = {"pitch": pitch, "phase": rng.uniform(0, 6.28), "second": 0.0 if form == "sine" else rng.uniform(0.1, 0.4)}
    return _core("cogging", form, scene, values, {"cog": f}, 0.5, {"pitch": "m"})


def hysteresis(rng: Rng, scene: Scene) -> Bound:
    """A spring with Bouc-Wen memory beside the linear one."""
    x, _, f = _motion(scene)
    total = rng.uniform(0.8, 1.2)
    beta = total * rng.uniform(0.5, 0.8)
    values = {"yield_": x * rng.uniform(0.15, 0.5), "beta": beta, "gamma": total - beta}
    return _core("hysteresis", "bouc_wen_spring", scene, values, {"loop": f}, 0.5)
