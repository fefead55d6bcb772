"""Drawing one case: a scene, its effects scaled to a severity, noise, and what the engineer believes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tools.research.prove import guests
from tools.research.prove import noise as noises
from tools.research.prove.catalog import TABLE, Entry
from tools.research.prove.forms_memory import Rng
from tools.research.prove.forms_unknown import NAME as UNKNOWN
from tools.research.prove.forms_unknown import unknown
from tools.research.prove.plants import Bound, Refit, Scene, Signals, simulate
from tools.research.prove.ports import same_place
from tools.research.prove.scenes import CONTEXTS, Wish, build, excitations_of

SEVERITIES = (2.0, 4.0, 10.0, 30.0)
KINDS = ("single", "pair", "agrees", "recalibrate", "unknown")
VISIBLE_SHARE = 0.12
ATTEMPTS = 12


class NotVisible(Exception):
    """The effect cannot reach its severity here: draw another scene."""


@dataclass(frozen=True)
class Truth:
    """One effect as it was put in; rms figures are in units of the output's noise rms."""

    name: str
    form: str
    strength: float
    outputs: tuple[str, ...]
    stages: tuple[str, ...]
    depends: tuple[str, ...]
    predictable: bool
    severity: float
    rms_raw: float
    rms_after_refit: float
    figures: dict[str, tuple[float, str]]


@dataclass(frozen=True)
class Plan:
    """What is asked of a case, before anything random inside it."""

    kind: str
    twin: str
    effects: tuple[str, ...]
    severity: float


@dataclass(frozen=True)
class Case:
    plan: Plan
    scene: Scene
    recorded: Signals
    noise: Signals
    truths: tuple[Truth, ...]
    noise_kind: str
    noise_rms: dict[str, float]
    declared: bool
    given: dict[str, Any]
    given_is_true: bool
    decoys: tuple[str, ...] = field(default_factory=tuple)


# a small lag, delay or stiff mode all look like the first derivative: they are told apart by their size, and a
# case counts only if the rival, fitted as well as it can be, leaves this many standard errors
LOOK_ALIKE: dict[str, tuple[str, ...]] = {
    "first_order_lag": ("dead_time",),
    "dead_time": ("first_order_lag",),
    "channel_delay": ("first_order_lag",),
    "resonance": ("dead_time", "first_order_lag"),
}
APART = 10.0


def _noise_level(rng: Rng, scene: Scene, plan: Plan) -> dict[str, float]:
    clean = simulate(scene)
    severity = max(plan.severity, 2.0)
    if set(plan.effects) & set(LOOK_ALIKE):
        rel = min(10 ** rng.uniform(-2.5, -1.2), 0.35 / severity)
    else:
        rel = min(10 ** rng.uniform(-3.0, -1.8), 0.1 / severity)
    return {k: max(rel * float(np.std(v)), 1e-12) * rng.uniform(0.9, 1.1) for k, v in clean.items()}


def _difference(scene: Scene, bound: Bound, s: float, clean: Signals, noisy: Signals) -> Signals:
    if bound.with_noise:
        after = bound.on_samples(noisy, s) if bound.on_samples else noisy
        return {k: after[k] - noisy[k] for k in clean}
    with_it = simulate(scene, [(bound, s)])
    return {k: with_it[k] - clean[k] for k in clean}


def scale(scene: Scene, bound: Bound, severity: float, sigma: dict[str, float], refit: Refit, noisy: Signals) -> float:
    """Strength at which the worst output keeps ``severity`` noise rms after the (linearised) re-fit."""
    clean = simulate(scene)

    def worst(s: float) -> float:
        d = _difference(scene, bound, s, clean, noisy)
        if not all(np.all(np.isfinite(v)) for v in d.values()):
            return np.inf
        return max(refit.remaining(d).values())

    low, high = bound.strength
    if low == high:
        return low
    top = worst(high)
    if not top >= severity:
        raise NotVisible(bound.name)

    def between(a: float, b: float) -> float:
        return float(np.sqrt(a * b)) if a > 0 else 0.5 * (a + b)

    # start where a proportional effect would be, then bracket by factors
    guess = float(np.clip(high * severity / top, low, high)) if np.isfinite(top) and low > 0 else between(low, high)
    value = worst(guess)
    for _ in range(60):
        if abs(value / severity - 1.0) < 0.03:
            return guess
        if value > severity:
            high = guess
        else:
            low = guess
        step = guess * severity / value if value > 0 and np.isfinite(value) and low > 0 else low
        guess = step if low < step < high else between(low, high)
        if abs(high - low) < 5e-4 * max(abs(high), 1e-3 if low <= 0 else 0.0):
            break
        value = worst(guess)
    if abs(value / severity - 1.0) > 0.25:
        raise NotVisible(bound.name)
    return guess


def _told_apart(scene: Scene, bound: Bound, s: float, refit: Refit, noise_kind: str) -> None:
    """Raise NotVisible when a look-alike effect in the same place could explain the recording as well."""
    for rival in LOOK_ALIKE.get(bound.name, ()):
        clean = simulate(scene)
        mine = _difference(scene, bound, s, clean, clean)
        size = max(refit.remaining(mine).values())
        other = same_place(rival, bound)
        try:
            near = scale(scene, other, size, {}, refit, clean)
        except NotVisible:
            continue
        best = np.inf
        for factor in np.linspace(0.6, 1.5, 10):
            his = _difference(scene, other, float(near * factor), clean, clean)
            best = min(best, max(refit.remaining({k: mine[k] - his[k] for k in mine}).values()))
        count = scene.keep * (0.1 if noise_kind == "coloured" else 1.0)
        if best * np.sqrt(count) < APART:
            raise NotVisible(f"{bound.name} looks like {rival}")


def _exact(
    scene: Scene, pairs: Sequence[tuple[Bound, float]], sigma: dict[str, float], refit: Refit
) -> tuple[float, float]:
    """(raw, after an exact re-fit) rms of the joint effect on the worst output, in noise rms."""
    clean, y = simulate(scene), simulate(scene, pairs)
    if not all(np.all(np.isfinite(v)) for v in y.values()):
        raise NotVisible("unstable")
    raw = max(float(np.sqrt(np.mean((y[k] - clean[k]) ** 2))) / sigma[k] for k in clean)
    left = max(refit.remaining_exact(y).values())
    # a constant is a bias, whatever the twin: it does not count as visible
    if left < VISIBLE_SHARE * max(float(np.std(y[k] - clean[k])) / sigma[k] for k in clean):
        raise NotVisible("taken up by the base parameters")
    return raw, left


def _bound(rng: Rng, entry: Entry, scene: Scene, name: str) -> Bound:
    bound = entry.make(rng, scene)
    assert bound.name == name
    return bound


def _wish(rng: Rng, plan: Plan, entries: Sequence[Entry], max_samples: int) -> Wish:
    options = excitations_of(plan.twin)
    if plan.kind == "unknown":
        options = tuple(o for o in options if o != "sine")  # one line leaves nothing to tell a product by
    for e in entries:
        options = tuple(o for o in options if o in e.under)
    if not options:
        raise NotVisible("no excitation shows both")
    contexts = [e.context for e in entries if e.context]
    spare = [c for c in CONTEXTS[plan.twin] if c not in contexts]
    if {"thermal_drift", "creep", "random_walk", "step_shift"} & set(plan.effects):
        spare = [c for c in spare if c != "temperature"]
    decoys = tuple(str(c) for c in rng.permutation(spare)[:1]) if spare and rng.random() < 0.35 else ()
    context = contexts[0] if contexts else None
    if plan.kind == "unknown":
        names = list(_strangers(plan.twin))
        if rng.random() < 0.75:
            context = str(rng.choice(names))
            decoys = tuple(str(c) for c in rng.permutation([c for c in CONTEXTS[plan.twin] if c != context])[:1])
    return Wish(
        twin=plan.twin,
        excitation=str(rng.choice(options)),
        context=context,
        decoys=decoys,
        all_axes=any(e.needs_all_axes for e in entries),
        least_s=max([e.least_s for e in entries], default=0.0),
        fast_only=any(e.fast_only for e in entries),
        bipolar="dead_zone" in plan.effects or "ac_coupling" in plan.effects,
        max_samples=max_samples,
    )


def _strangers(twin: str) -> tuple[str, ...]:
    few = {"piezo_stack": ("load",), guests.INSTRUMENT: ("pressure", "humidity")}
    return few.get(twin, ("pressure", "humidity", "load"))


def believed(rng: Rng, scene: Scene, share: float) -> dict[str, Any]:
    """The descriptor's parameters: the true ones moved by about ``share``."""
    p = dict(scene.parameters)

    def move(v: Any, around: float = 0.0) -> Any:
        if isinstance(v, list):
            return [move(x, around) for x in v]
        sign = float(rng.choice([-1.0, 1.0]))
        return float(v + sign * share * rng.uniform(0.5, 1.0) * (abs(v) + around))

    moved = ("gain_um_per_V", "scale_V_per_g", "scale_V_per_uT", "mass", "damping", "stiffness")
    for key in (*moved, "um_per_W", "time_constant_s", "arm_um", "rad_per_V"):
        if key in p:
            p[key] = move(p[key])
    if "bias_V" in p:
        p["bias_V"] = move(p["bias_V"])
    if "offset_um" in p:
        p["offset_um"] = move(p["offset_um"], 1.0)
    if p.get("offset_force"):
        p["offset_force"] = move(p["offset_force"])
    if scene.twin == "state_space":
        p["C"] = [[v * (1.0 + share * rng.uniform(-1, 1)) for v in row] for row in p["C"]]
        p["y0"] = move(p["y0"], 0.1)
        if not p.get("discrete"):
            w = 1.0 + share * rng.uniform(-1, 1)
            p["A"] = [[v if v in (0.0, 1.0) else v * w for v in row] for row in p["A"]]
            p["B"] = [[v if v in (0.0, 1.0) else v * w for v in row] for row in p["B"]]
    return p


def _recalibration(rng: Rng, scene: Scene, sigma: dict[str, float], severity: float) -> dict[str, Any]:
    """Wrong parameters whose error is about ``severity`` noise rms on the worst output."""
    truth, share = simulate(scene), 0.02
    state = rng.bit_generator.state
    p = dict(scene.parameters)
    for _ in range(12):
        rng.bit_generator.state = state
        p = believed(rng, scene, share)
        y = simulate(scene, parameters={**p, **scene.hidden})
        rms = max(float(np.sqrt(np.mean((y[k] - truth[k]) ** 2))) / sigma[k] for k in truth)
        if 0.8 < rms / severity < 1.25:
            return p
        share = float(np.clip(share * np.clip(severity / rms, 0.1, 10.0), 1e-6, 0.3))
    return p


def make(seed: Sequence[int], plan: Plan, max_samples: int = 24_000, noise_kind: str | None = None) -> Case:
    """The case of this seed and plan. Raises NotVisible when no scene of a dozen shows the effect."""
    for attempt in range(ATTEMPTS):
        rng = np.random.default_rng([*seed, attempt])
        try:
            return _attempt(rng, plan, max_samples, noise_kind)
        except NotVisible:
            continue
    raise NotVisible(f"{plan}")


def _attempt(rng: Rng, plan: Plan, max_samples: int, noise_kind: str | None) -> Case:
    entries = [TABLE[plan.twin][name] for name in plan.effects]
    wish = _wish(rng, plan, entries, max_samples)
    scene = build(rng, wish)
    sigma = _noise_level(rng, scene, plan)
    kind = noise_kind or str(rng.choice(noises.KINDS, p=[0.4, 0.25, 0.2, 0.15]))
    noise = {k: noises.draw(rng, kind, scene.t.size, sigma[k]) for k in scene.outputs}
    steps: dict[str, float] = {}
    if kind == "quantised":
        for k in scene.outputs:
            steps[k], sigma[k] = noises.rounding_step(rng, sigma[k])
    refit = Refit(scene, sigma)
    noisy = simulate(scene, noise=noise)
    bounds: list[Bound] = [_bound(rng, e, scene, n) for e, n in zip(entries, plan.effects, strict=True)]
    if plan.kind == "unknown":
        bounds = [unknown(rng, scene, wish.context)]
    pairs: list[tuple[Bound, float]] = []
    truths: list[Truth] = []
    for bound in bounds:
        s = scale(scene, bound, plan.severity, sigma, refit, noisy)
        if bound.with_noise:
            d = _difference(scene, bound, s, noisy, noisy)
            raw = max(float(np.sqrt(np.mean(d[k] ** 2))) / sigma[k] for k in d)
            left = max(refit.remaining(d).values())
        else:
            raw, left = _exact(scene, [(bound, s)], sigma, refit)
            if bound.strength[0] == bound.strength[1]:  # nature sets the strength: set the noise instead
                factor = left / plan.severity
                sigma = {k: v * factor for k, v in sigma.items()}
                noise = {k: v * factor for k, v in noise.items()}
                steps = {k: v * factor for k, v in steps.items()}
                refit = Refit(scene, sigma)
                raw, left = raw / factor, left / factor
            elif abs(left / plan.severity - 1.0) > 0.08:
                # the exact re-fit takes more (or less) than the tangent: one correction
                s = float(np.clip(s * plan.severity / left, *bound.strength))
                raw, left = _exact(scene, [(bound, s)], sigma, refit)
        if not 0.8 < left / plan.severity < 1.25:
            raise NotVisible(bound.name)
        _told_apart(scene, bound, s, refit, kind)
        figures = {}
        if bound.truth:
            key = next(iter(scene.inputs))
            figures = {
                q: (v, {"drive": f"unit of {key}", "output": f"unit of {bound.outputs[0]}"}.get(u, u))
                for q, (v, u) in bound.truth(s).items()
            }
        pairs.append((bound, s))
        truths.append(
            Truth(
                bound.name,
                bound.form,
                s,
                bound.outputs,
                bound.stages,
                bound.depends,
                bound.predictable,
                plan.severity,
                raw,
                left,
                figures,
            )
        )
    recorded = simulate(scene, pairs, noise=noise)
    for k, q in steps.items():
        recorded[k] = np.round(recorded[k] / q) * q
    if not all(np.all(np.isfinite(v)) for v in recorded.values()):
        raise NotVisible("unstable")
    quiet = simulate(scene, [p for p in pairs if not p[0].with_noise])
    left_over = {k: recorded[k] - quiet[k] for k in recorded}
    if any(b.with_noise for b in bounds):  # steps coarser than the noise are the effect, not the noise
        left_over = {k: noise[k][: scene.keep] for k in recorded}
    if plan.kind == "recalibrate":
        given, true = _recalibration(rng, scene, sigma, plan.severity), False
    elif plan.kind == "agrees" or rng.random() < 0.5:
        given, true = dict(scene.parameters), True
    else:
        given, true = believed(rng, scene, 0.02), False
    return Case(
        plan, scene, recorded, left_over, tuple(truths), kind, sigma, bool(rng.random() < 0.5), given, true, wish.decoys
    )


__all__ = ["KINDS", "SEVERITIES", "UNKNOWN", "Case", "NotVisible", "Plan", "Truth", "make"]
