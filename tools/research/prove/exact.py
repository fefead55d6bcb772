"""Exact scores of one report against its sealed answer, and what they add up to. Nothing is filtered.

A set of names is right when the verdict is right and no name is missing or too many; the same name on several outputs
counts once. "Grouped" is the weaker score: names that the report itself calls equivalent may stand for each other.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise, permutations
from types import MappingProxyType
from typing import Any

import numpy as np

from tools.research.prove import guests
from tools.research.prove.score import count_true, coverage, names_of

Row = Mapping[str, Any]
EXPECTED = MappingProxyType(
    {
        "single": "missing_physics", "pair": "missing_physics", "unknown": "unexplained",
        "agrees": "agrees", "recalibrate": "recalibrate",
    }
)  # fmt: skip
NULL = ("agrees", "recalibrate")
KINDS = MappingProxyType(
    {
        "piezo_stack": "static", "accelerometer": "static", "magnetometer": "static",
        "accelerometer_cluster": "cluster", "state_space": "state space", "mechanical_axis": "axis",
        guests.FMU: "FMU", guests.USER: "user's", guests.INSTRUMENT: "bench",
    }
)  # fmt: skip
"""Kinds of twin that are reported apart."""
EDGES = (0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 0.99, 1.0 + 1e-9)
"""Edges of the reliability diagram's bins: most names are said to be rather sure."""


def score_exactly(answer: Row, report: Row) -> dict[str, Any]:
    """Return a row with the truth, the answer, and every exact score of it."""
    kind = str(answer["kind"])
    verdict = str(report.get("verdict", "error"))
    true = list(dict.fromkeys(str(t["name"]) for t in answer["effects"] if t["name"] != "unknown"))
    named = list(dict.fromkeys(names_of(report)))
    groups = [set(map(str, g.get("names", []))) for g in report.get("equivalent") or []]
    verdict_right = verdict == EXPECTED[kind]
    set_right = verdict_right and set(named) == set(true)
    if kind == "unknown":
        set_right = verdict_right  # names beside an "unexplained" are counted as false ones, below
    false = [n for n in named if n not in true]
    wrong = not set_right
    return {
        "kind": kind, "twin": str(answer["twin"]), "twin_kind": KINDS.get(str(answer["twin"]), "other"),
        "severity": answer["severity"], "excitation": answer["excitation"], "noise_kind": answer["noise_kind"],
        "form": [t["form"] for t in answer["effects"]], "true": true, "said": named, "verdict": verdict,
        "verdict_right": verdict_right,
        "first_right": bool(named) and named[0] in true if true else None,
        "set_right": set_right,
        "grouped_right": verdict_right and _grouped(true, named, groups) if true else set_right,
        "group_sizes": [len(g) for g in groups],
        "false_names": len(false),
        "flagged": wrong and verdict == "unexplained",
        "sure": _surenesses(report, true),
        "intervals": coverage(report, answer, far_off=True) if true else [],
        "error": report.get("error"),
        "seconds": report.get("seconds"),
    }  # fmt: skip


def _grouped(true: Sequence[str], named: Sequence[str], groups: Sequence[set[str]]) -> bool:
    """Return True if the reported names are the true ones up to equivalences that the report states."""
    if len(true) != len(named):
        return False

    def same(a: str, b: str) -> bool:
        return a == b or any(a in g and b in g for g in groups)

    return any(all(same(a, b) for a, b in zip(true, order, strict=True)) for order in permutations(named))


def _surenesses(report: Row, true: Sequence[str]) -> list[list[float]]:
    """[how sure, 1 if right] per name; the same name on several outputs counts once, by its surest."""
    best: dict[str, float] = {}
    for p in report.get("physics") or []:
        name, sure = str(p.get("name", "")), p.get("confidence")
        if sure is not None:
            best[name] = max(best.get(name, 0.0), float(sure))
    return [[sure, float(name in true)] for name, sure in best.items()]


def reliability(pairs: Iterable[Sequence[float]]) -> dict[str, Any]:
    """The reliability diagram of (stated probability, 1 if right) and the expected calibration error.

    ``bins``: [low, high, mean stated, share right, count] of those that hold something; the error is the mean distance
    of the last two, weighted by count (Naeini et al. 2015).
    """
    data = np.array([list(p) for p in pairs], float).reshape(-1, 2)
    bins: list[list[float]] = []
    for low, high in pairwise(EDGES):
        inside = data[(data[:, 0] >= low) & (data[:, 0] < high)]
        if inside.size:
            bins.append([low, min(high, 1.0), *map(float, inside.mean(axis=0)), float(len(inside))])
    total = sum(b[4] for b in bins)
    error = sum(b[4] * abs(b[2] - b[3]) for b in bins) / total if total else None
    return {"names": len(data), "expected_calibration_error": error, "bins": bins}


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """Every figure over all rows, and per kind of twin; counts are [number, of]."""
    apart = {kind: [r for r in rows if r["twin_kind"] == kind] for kind in dict.fromkeys(KINDS.values())}
    return {**_figures(rows), "by_twin_kind": {k: _figures(v) for k, v in apart.items() if v}}


def _figures(rows: Sequence[Row]) -> dict[str, Any]:
    single, pairs = ([r for r in rows if r["kind"] == k] for k in ("single", "pair"))
    unknown = [r for r in rows if r["kind"] == "unknown"]
    nulls = [r for r in rows if r["kind"] in NULL]
    missing = [*single, *pairs, *unknown]
    named = [*single, *pairs]
    intervals = [i for r in rows for i in r["intervals"]]
    wrong = [r for r in named if not r["set_right"]]
    cpu_s = sorted(float(r["cpu_s"]) for r in rows if r.get("cpu_s") is not None)
    return {
        "cases": len(rows),
        "verdict_right": count_true(rows, "verdict_right"),
        "first_right": count_true(named, "first_right"),
        "set_right_single": count_true(single, "set_right"),
        "set_right_pair": count_true(pairs, "set_right"),
        "grouped_right": count_true(named, "grouped_right"),
        "unknown_unexplained": count_true(unknown, "verdict_right"),
        "null_right": count_true(nulls, "verdict_right"),
        "extra_names": [sum(r["false_names"] > 0 and r["kind"] != "unknown" for r in missing), len(named)],
        "wrong_not_flagged": [sum(not r["flagged"] for r in wrong), len(named)],
        "false_names_given_missing": [sum(r["false_names"] for r in missing), len(missing)],
        "false_names_under_null": [sum(r["false_names"] for r in nulls), len(nulls)],
        "intervals_hold": [sum(bool(i["covered"]) for i in intervals), len(intervals)],
        "errors": [sum(bool(r.get("error")) for r in rows), len(rows)],
        "reliability": reliability(p for r in rows for p in r["sure"]),
        "cpu_s": {
            "total": round(sum(cpu_s), 1),
            "median": cpu_s[len(cpu_s) // 2] if cpu_s else None,
            "longest": cpu_s[-1] if cpu_s else None,
        },
    }
