"""Designs the input that separates rival models best: it maximises the least separation of any two over waveforms.

The criterion is expensive and has many optima, so the search is simple: described inputs and random points of every
family on a reduced budget, then a (1 + 1) evolution strategy with the one-fifth rule (Rechenberg 1973) from the best.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tools.mismatch.plan.limits import Limits
from tools.mismatch.plan.models import Rival, pairs_of, separation, separations
from tools.mismatch.plan.situation import Situation
from tools.mismatch.plan.waveforms import FAMILIES, LIBRARY, SIZE, draw, mean_square, random_multisine
from tools.mismatch.recording import Array

Progress = Callable[[str, int, int], None]

RANDOM_PER_FAMILY = 3
REFINED = 2
FINALISTS = 4
QUICK, FULL = 4, 25
"""Number of iterations of a rival's re-fit during the comparison of candidates, and for the printed figures."""
COMPARED = 5
"""Number of random multisines of equal energy whose median separation is printed beside the plan."""
ENERGIES_SEED = 77


@dataclass(frozen=True)
class Plan:
    """Holds a planned input ``waves[signal]`` (n,) and the least separation of any two rivals in standard deviations.

    It also has the median of that separation for random multisines of equal energy; ``description`` names the family;
    ``pairs`` is the separation of each pair, the closest first.
    """

    waves: Mapping[str, Array]
    limits: Mapping[str, Limits]
    dt: float
    description: str
    separation: float
    random_separation: float
    pairs: Mapping[str, float]
    evaluations: int


@dataclass(frozen=True)
class _Point:
    family: str
    z: NDArray[np.float64]
    value: float
    name: str = ""
    exact: bool = True
    """False if ``value`` is only a bound, which ruled the point out as a finalist."""


def design(
    where: Situation,
    rivals: Sequence[Rival],
    limits: Mapping[str, Limits],
    sigma: Mapping[str, float],
    *,
    evaluations: int = 80,
    seed: int = 0,
    compared: int = COMPARED,
    progress: Progress | None = None,
) -> Plan:
    """Design the inputs named in ``limits`` together (each is a waveform of the same family).

    ``evaluations``: inputs that are tried; ``compared``: random multisines beside the plan. Same arguments: same plan.
    """
    rng = np.random.default_rng(seed)
    done = 0
    signals = tuple(limits)
    pairs = pairs_of(rivals)

    def waves(family: str, z: NDArray[np.float64]) -> dict[str, Array]:
        parts = np.split(z, len(signals))
        return {s: draw(family, p, limits[s], where.dt) for s, p in zip(signals, parts, strict=True)}

    def value(family: str, z: NDArray[np.float64], floor: float = -1.0) -> float:
        nonlocal done
        done += 1
        if progress is not None:
            progress("inputs", done, evaluations)
        found = separations(where.course(waves(family, z)), pairs, sigma, QUICK, floor, thorough=True)
        return min(found.values())

    named = [(name, family, np.tile(z, len(signals))) for name, (family, z) in LIBRARY.items()]
    drawn = [("", f, rng.random(SIZE[f] * len(signals))) for f in FAMILIES for _ in range(RANDOM_PER_FAMILY)]
    points: list[_Point] = []
    for name, family, z in (*named, *drawn):
        # the value of a point that cannot be a finalist is a bound
        floor = points[FINALISTS - 1].value if len(points) >= FINALISTS else -1.0
        found = value(family, z, floor)
        points.append(_Point(family, z, found, name, found > floor))
        points.sort(key=lambda p: -p.value)
    ends = points[:FINALISTS]
    share = max(0, evaluations - done) // REFINED
    for start in _unlike(points, REFINED) if share else ():
        now, step = start if start.exact else replace(start, value=value(start.family, start.z)), 0.2
        for _ in range(share):
            z = now.z + step * rng.standard_normal(now.z.size)
            z = np.abs(z) % 2.0
            z = np.where(z > 1.0, 2.0 - z, z)
            found = value(now.family, z, now.value)
            if found > now.value:
                now, step = _Point(now.family, z, found, now.name), min(step * 1.5, 0.5)
            else:
                step = max(step * 1.5**-0.25, 0.01)
        ends.append(now)
    # an incomplete search overestimates an input, so the finalists are followed to convergence, the best first
    top, best, apart = -1.0, ends[0], dict[str, float]()
    for p in sorted(ends, key=lambda p: -p.value):
        found = separations(where.course(waves(p.family, p.z)), pairs, sigma, FULL, top, thorough=True)
        if min(found.values()) > top:
            top, best, apart = min(found.values()), p, found
    chosen = waves(best.family, best.z)
    return Plan(
        chosen,
        dict(limits),
        where.dt,
        best.name or best.family,
        top,
        random_separation(where, rivals, chosen, limits, sigma, seed=seed, compared=compared),
        dict(sorted(apart.items(), key=lambda pair: pair[1])),
        done,
    )


def _unlike(points: Sequence[_Point], count: int) -> list[_Point]:
    """Return the best points of different families."""
    out: list[_Point] = []
    for p in points:
        if p.family not in {q.family for q in out}:
            out.append(p)
    return out[:count]


def random_inputs(
    waves: Mapping[str, Array], limits: Mapping[str, Limits], dt: float, rng: np.random.Generator
) -> dict[str, Array]:
    """Return a random multisine for each input, with the energy of the planned one."""
    return {s: random_multisine(rng, limits[s], dt, mean_square(x, limits[s])) for s, x in waves.items()}


def random_separation(
    where: Situation,
    rivals: Sequence[Rival],
    waves: Mapping[str, Array],
    limits: Mapping[str, Limits],
    sigma: Mapping[str, float],
    *,
    seed: int,
    compared: int = COMPARED,
) -> float:
    """Return the median separation on ``compared`` random multisines of equal energy; NaN without one."""
    rng = np.random.default_rng([seed, ENERGIES_SEED])
    found = [
        separation(where.course(random_inputs(waves, limits, where.dt, rng)), rivals, sigma, FULL, thorough=True)
        for _ in range(compared)
    ]
    return float(np.median(found)) if found else math.nan
