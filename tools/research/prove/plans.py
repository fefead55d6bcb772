"""What a proof asks: a balanced list of cases, before anything random inside them."""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType

import numpy as np

from tools.research.prove import guests
from tools.research.prove.catalog import RIVALS, TABLE, TWINS
from tools.research.prove.draw import SEVERITIES, Plan
from tools.research.prove.forms_memory import Rng
from tools.research.prove.scenes import excitations_of

NOTHING_TO_REFIT = ("accelerometer_cluster", guests.INSTRUMENT)
"""No base parameter that is not an effect of its own."""


def plans(seed: int, count: int, only: tuple[str, str, float] | None = None) -> list[Plan]:
    """A balanced list: every effect name in turn, then pairs, controls, effects outside the vocabulary.

    ``only`` = (twin, effect, severity), empty or zero where free, restricts the single effects.
    """
    rng = np.random.default_rng([seed, 7])
    if only is not None:
        return _restricted(rng, count, only)
    share = {"single": 0.55, "pair": 0.125, "agrees": 0.1, "recalibrate": 0.1, "unknown": 0.125}
    number = {k: round(v * count) for k, v in share.items()}
    number["single"] += count - sum(number.values())
    out: list[Plan] = []
    names = sorted({n for t in TABLE.values() for n in t})
    deck: list[str] = []
    for i in range(number["single"]):
        if not deck:
            deck = [str(n) for n in rng.permutation(names)]
        name = deck.pop()
        twin = _twin(rng, [t for t in TWINS if name in TABLE[t]])
        out.append(Plan("single", twin, (name,), SEVERITIES[i % 4]))
    for _ in range(number["pair"]):
        out.append(Plan("pair", *_pair(rng), float(rng.choice(SEVERITIES[1:]))))
    for kind in ("agrees", "recalibrate"):
        for _ in range(number[kind]):
            twin = _twin(rng, TWINS)
            if kind == "recalibrate" and twin in NOTHING_TO_REFIT:
                twin = "piezo_stack"
            out.append(Plan(kind, twin, (), float(rng.choice(SEVERITIES))))
    for _ in range(number["unknown"]):
        out.append(Plan("unknown", _twin(rng, TWINS), (), float(rng.choice(SEVERITIES[1:]))))
    return [out[i] for i in rng.permutation(len(out))]


SELDOM = MappingProxyType({guests.FMU: 0.5, guests.INSTRUMENT: 0.25})
"""Every run of these is a whole program: that often beside the other kinds."""


def _twin(rng: Rng, among: Sequence[str]) -> str:
    weight = np.array([SELDOM.get(t, 1.0) for t in among])
    return str(rng.choice(list(among), p=weight / weight.sum()))


def _pair(rng: Rng) -> tuple[str, tuple[str, ...]]:
    while True:
        twin = _twin(rng, TWINS)
        a, b = (str(n) for n in rng.choice(list(TABLE[twin]), 2, replace=False))
        if any({a, b} <= g for g in RIVALS):
            continue
        shared = set(TABLE[twin][a].under) & set(TABLE[twin][b].under) & set(excitations_of(twin))
        contexts = {TABLE[twin][n].context for n in (a, b)} - {None}
        if shared and len(contexts) < 2:
            return twin, (a, b)


def _restricted(rng: Rng, count: int, only: tuple[str, str, float]) -> list[Plan]:
    twin, effect, severity = only
    out: list[Plan] = []
    for i in range(count):
        sev = severity or SEVERITIES[i % 4]
        if effect in ("agrees", "recalibrate", "unknown"):
            out.append(Plan(effect, twin or str(rng.choice(TWINS)), (), sev))
            continue
        if effect == "pair":
            t, names = _pair(rng)
            while twin and t != twin:
                t, names = _pair(rng)
            out.append(Plan("pair", t, names, sev))
            continue
        twins = [t for t in TWINS if (not twin or t == twin) and (not effect or effect in TABLE[t])]
        if not twins:
            raise ValueError(f"no twin of {TWINS} shows {effect!r} on {twin or 'any twin'}")
        t = str(rng.choice(twins))
        out.append(Plan("single", t, (effect or str(rng.choice(list(TABLE[t]))),), sev))
    return out
