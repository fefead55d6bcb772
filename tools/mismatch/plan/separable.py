"""Finds the effects that a planned recording could distinguish, their sizes, and what would split the others."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sim_devices.physics.catalogue import EFFECTS
from sim_devices.physics.effect import Effect
from tools.mismatch.engine.identifiability import experiment
from tools.mismatch.plan.limits import Limits
from tools.mismatch.plan.responses import Response, ground, responses
from tools.mismatch.plan.situation import Situation
from tools.mismatch.plan.waveforms import LIBRARY, draw, random_multisine
from tools.mismatch.recording import Array, Recording
from tools.mismatch.simulate_sites import why_not
from tools.mismatch.twins.vocabulary import CONTEXT_UNITS

THRESHOLD = 5.0
"""Least size of a response, or of a difference of responses, in standard deviations of the noise."""
DEFAULT_INPUT = "a random multisine"


@dataclass(frozen=True)
class Shown:
    """Holds the ``smallest_rms`` of an effect on its output, in noise rms, that is visible beside a re-fit."""

    name: str
    place: str
    smallest_rms: float


@dataclass(frozen=True)
class Pair:
    """Compares two effects.

    ``degrees`` is the larger of the two angles between the response of one and the span of the other; ``size`` is the
    rms, in noise rms, from which one of them cannot imitate the other; ``sizes`` are those values if the first or if
    the second effect is present.
    """

    names: tuple[str, str]
    degrees: float
    size: float
    sizes: tuple[float, float]


@dataclass(frozen=True)
class Splitter:
    """Names the experiment that splits a pair: ``what`` in words; ``size`` with it, in noise rms (None: unknown)."""

    names: tuple[str, str]
    what: str
    size: float | None


@dataclass(frozen=True)
class Separable:
    """Holds the separable effects.

    ``groups``: effects of which each is too close to the next; ``imitated``: (effect, rival) where the rival imitates
    the effect on this input and on every described one, so that no waveform speaks for the effect, though one may speak
    for the rival; ``not_moved``: effects that this input does not excite; ``not_here``: effects that these channels
    cannot have, with the reason.
    """

    input: str
    samples: int
    size: float
    visible: tuple[Shown, ...]
    pairs: tuple[Pair, ...]
    groups: tuple[tuple[str, ...], ...]
    splitters: tuple[Splitter, ...]
    imitated: tuple[tuple[str, str], ...]
    not_moved: tuple[str, ...]
    not_here: Mapping[str, str]


def pair_of(a: Response, b: Response) -> Pair:
    """Holds how far two effects are apart."""
    sines = (_sine(a, b), _sine(b, a))
    sizes = tuple(THRESHOLD / max(s * r.norm_per_rms, 1e-300) for s, r in zip(sines, (a, b), strict=True))
    degrees = float(np.degrees(np.arcsin(min(1.0, max(sines)))))
    return Pair((a.effect.name, b.effect.name), degrees, min(sizes), (sizes[0], sizes[1]))


def _sine(a: Response, b: Response) -> float:
    """Return the sine of the angle between the response of ``a`` and the nearest space of ``b``."""
    inside = max((float(np.sum((space.T @ a.move) ** 2)) for space in b.tangents), default=0.0)
    return float(np.sqrt(max(0.0, 1.0 - inside)))


def _strongest(found: Iterable[Response]) -> list[Response]:
    """Return a response per effect, at the place where it is strongest."""
    out: dict[str, Response] = {}
    for r in found:
        if r.effect.name not in out or r.norm_per_rms > out[r.effect.name].norm_per_rms:
            out[r.effect.name] = r
    return list(out.values())


def groups_of(pairs: Sequence[Pair], size: float) -> tuple[tuple[str, ...], ...]:
    """Return the groups of effects that are joined by pairs that cannot be distinguished at ``size``."""
    groups: list[set[str]] = []
    for p in pairs:
        if p.size <= size:
            continue
        touched = [g for g in groups if g & set(p.names)]
        joined = set(p.names).union(*touched)
        groups = [g for g in groups if g not in touched] + [joined]
    return tuple(tuple(sorted(g)) for g in sorted(groups, key=lambda g: sorted(g)))


def separable(
    where: Situation,
    limits: Mapping[str, Limits],
    sigma: Mapping[str, float],
    *,
    size: float,
    given: Mapping[str, Array] | None = None,
    seed: int = 0,
    effects: Sequence[Effect] | None = None,
) -> Separable:
    """Return the effects of ``size`` noise rms that the channels of a situation could distinguish.

    The input is ``given`` or a random multisine. For each pair that is too close, the result names the input or channel
    that would split it.
    """
    catalogue = tuple(effects if effects is not None else EFFECTS.values())
    rng = np.random.default_rng([seed, 3])
    waves = given or {s: random_multisine(rng, box, where.dt) for s, box in limits.items()}
    course = where.course(waves)
    on = ground(course, sigma, seed)
    found = _strongest(responses(on, catalogue, size))
    pairs = [pair_of(a, b) for i, a in enumerate(found) for b in found[i + 1 :]]
    one_way = [p for p in pairs if max(p.sizes) > size]
    best = _best_sizes(where, limits, sigma, size, seed, one_way)
    absent = {e.name: why for e in catalogue if (why := why_not(on.problem.twin, course, e))}
    moved = {r.effect.name for r in found}
    return Separable(
        "as given" if given else DEFAULT_INPUT,
        course.n,
        size,
        tuple(
            Shown(r.effect.name, r.placed.target or r.placed.outputs[0], THRESHOLD / r.norm_per_rms)
            for r in sorted(found, key=lambda r: -r.norm_per_rms)
        ),
        tuple(sorted(pairs, key=lambda p: -p.size)),
        groups_of(pairs, size),
        tuple(_splitter(p, size, best[p.names]) for p in one_way if p.size > size),
        tuple(
            (p.names[k], p.names[1 - k]) for p in one_way for k in (0, 1) if min(p.sizes[k], best[p.names][k][0]) > size
        ),
        tuple(sorted(e.name for e in catalogue if e.name not in moved and e.name not in absent)),
        absent,
    )


Best = tuple[tuple[float, str], tuple[float, str]]
"""For either effect of a pair the smallest size from which the other cannot imitate it, and the input in words."""


def _best_sizes(
    where: Situation, limits: Mapping[str, Limits], sigma: Mapping[str, float], size: float, seed: int,
    pairs: Sequence[Pair],
) -> dict[tuple[str, str], Best]:  # fmt: skip
    """Return the best of the described inputs for each of some pairs, infinite where none excites both effects."""
    best: dict[tuple[str, str], Best] = {p.names: ((np.inf, ""), (np.inf, "")) for p in pairs}
    effects = [EFFECTS[n] for n in sorted({n for p in pairs for n in p.names}) if n in EFFECTS]
    for words, (family, z) in LIBRARY.items() if pairs else ():
        course = where.course({s: draw(family, np.asarray(z), box, where.dt) for s, box in limits.items()})
        found = {r.effect.name: r for r in _strongest(responses(ground(course, sigma, seed), effects, size))}
        for p in pairs:
            a, b = (found.get(n) for n in p.names)
            if a is not None and b is not None:
                now, old = pair_of(a, b).sizes, best[p.names]
                best[p.names] = (min(old[0], (now[0], words)), min(old[1], (now[1], words)))
    return best


def _splitter(p: Pair, size: float, best: Best) -> Splitter:
    """Return the described input that splits a close pair at the smallest size, else the experiment in words."""
    value, words = min(best)
    if value <= size:
        return Splitter(p.names, words, value)
    a, b = (EFFECTS[n] for n in p.names)
    return Splitter(p.names, experiment(a, b), None)


def channel_gains(
    where: Situation, limits: Mapping[str, Limits], sigma: Mapping[str, float], *, size: float, seed: int = 0
) -> dict[str, tuple[str, ...]]:
    """Return for each unrecorded context channel the effects that could be named with it.

    They must be distinguishable from all others that the recording then shows. The channel's course is random and slow.
    """
    out: dict[str, tuple[str, ...]] = {}
    rng = np.random.default_rng([seed, 11])
    waves = {s: random_multisine(rng, box, where.dt) for s, box in limits.items()}
    course = where.course(waves)
    for signal in CONTEXT_UNITS:
        if signal in course.signals:
            continue
        needing = [e for e in EFFECTS.values() if signal in e.needs]
        if not needing:
            continue
        more = with_context(course, signal, rng)
        found = _strongest(responses(ground(more, sigma, seed), EFFECTS.values(), size))
        names = {e.name for e in needing}
        apart = [
            r.effect.name
            for r in found
            if r.effect.name in names and all(pair_of(r, o).size <= size for o in found if o is not r)
        ]
        if apart:
            out[signal] = tuple(apart)
    return out


def with_context(course: Recording, signal: str, rng: np.random.Generator) -> Recording:
    """Return the recording with a context channel that wanders slowly, one unit rms."""
    x = np.cumsum(rng.standard_normal(course.n))
    x = (x - x.mean()) / max(float(x.std()), 1e-300)
    unit = CONTEXT_UNITS[signal][0]
    return replace(
        course,
        context={**course.context, signal: x},
        unit={**course.unit, signal: unit},
        column={**course.column, signal: signal},
    )
