"""Scoring one diagnosis against the sealed answer. Reads only the JSON report of the contract's section 5."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from tools.mismatch.units import same_dimension
from tools.research.prove.disk import contract_unit

FALSE_ALARM = ("missing_physics", "unexplained")
TO_SI = {
    "s": 1.0, "ms": 1e-3, "us": 1e-6, "Hz": 1.0, "kHz": 1e3, "1": 1.0, "": 1.0, "%": 1e-2, "ppm": 1e-6, "V": 1.0,
    "mV": 1e-3, "um": 1e-6, "mm": 1e-3, "m": 1.0, "N": 1.0, "g": 9.80665, "mg": 9.80665e-3, "m/s^2": 1.0, "uT": 1e-6,
}  # fmt: skip
# what a report may call a figure of the answer
SAME = {
    "delay": ("delay", "dead_time"),
    "time_constant": ("time_constant", "tau"),
    "corner": ("corner", "cutoff", "cut_off", "bandwidth"),
    "frequency": ("frequency", "f0", "line"),
    "gap": ("gap", "width", "play"),
    "half_gap": ("half",),
    "sliding": ("coulomb", "sliding", "friction_force", "kinetic"),
    "static": ("static", "breakaway", "stiction"),
    "pitch": ("pitch", "period"),
    "skew": ("skew", "ppm", "rate_error"),
    "step": ("step", "lsb", "quant"),
    "time": ("time", "at_s", "instant"),
    "damping_ratio": ("damping", "zeta"),
}
# part of the true noise rms by which a held-out rms may fall below it by chance
CHANCE = {"white": 0.05, "quantised": 0.05, "coloured": 0.15, "heavy_tailed": 0.15}


def names_of(report: Mapping[str, Any]) -> list[str]:
    return [str(p.get("name", "")) for p in report.get("physics") or []]


def _group(report: Mapping[str, Any], name: str) -> set[str]:
    out = {name}
    for g in report.get("equivalent") or []:
        if name in g.get("names", []):
            out |= set(g["names"])
    return out


def _rms(report: Mapping[str, Any], key: str, output: str) -> float | None:
    value = ((report.get("fit") or {}).get(key) or {}).get(output)
    if value is None:
        return None
    unit = ((report.get("fit") or {}).get("unit") or {}).get(output, contract_unit(output))
    home = contract_unit(output)
    if unit != home and unit in TO_SI and home in TO_SI:
        value = value * TO_SI[unit] / TO_SI[home]
    return float(value)


def fit_figures(
    report: Mapping[str, Any],
    answer: Mapping[str, Any],
    outputs: Sequence[str],
    oracle: Mapping[str, float] | None = None,
) -> dict[str, Any]:
    """Held-out rms against the known noise on ``outputs``: ratio, explained share, below-noise flag."""
    noise = oracle or answer["noise_rms"]
    chance = CHANCE[answer["noise_kind"]]
    if oracle and answer["noise_kind"] != "quantised":  # rounding follows the signal, so a fit can take part of it
        chance = 0.02
    ratio, explained, below = 0.0, 1.0, False
    found = False
    for out in outputs:
        fitted = _rms(report, "fitted_rms", out)
        before = _rms(report, "recalibrated_rms", out)
        if fitted is None or before is None:
            continue
        found = True
        sigma = noise[out]
        ratio = max(ratio, fitted / sigma)
        below |= fitted < sigma * (1.0 - chance)
        room = before**2 - sigma**2
        if room > 0.25 * sigma**2:
            explained = min(explained, (before**2 - fitted**2) / room)
    if not found:
        return {"ratio": None, "explained": None, "below_noise": False}
    return {"ratio": ratio, "explained": explained, "below_noise": below}


def coverage(report: Mapping[str, Any], answer: Mapping[str, Any], *, far_off: bool = False) -> list[dict[str, Any]]:
    """Return which figures of the answer were reported, and whether their 95 % interval holds the true value.

    ``far_off``: figures that are more than ten times off count, too, and a figure without an interval does not hold.
    A figure of another dimension is no figure of the answer: a gap at an output in um, where the true one is in volts
    of the input.
    """
    rows: list[dict[str, Any]] = []
    for truth in answer["effects"]:
        named = [p for p in report.get("physics") or [] if p.get("name") == truth["name"]]
        if not named:
            continue
        for quantity, (value, unit) in truth["figures"].items():
            home = contract_unit(unit.removeprefix("unit of ")) if unit.startswith("unit of ") else unit
            for name, par in (named[0].get("parameters") or {}).items():
                same = any(word in name.lower() for word in SAME.get(quantity, (quantity,)))
                if quantity == "gap" and "half" in name:
                    same = False
                par_unit = str(par.get("unit", ""))
                ci = par.get("ci95")
                known = par_unit in TO_SI and home in TO_SI and same_dimension(par_unit or "1", home or "1")
                if not same or not known:
                    continue
                k = TO_SI[par_unit] / TO_SI[home]
                if not ci or None in ci:
                    if not far_off:
                        continue
                    ci = (math.nan, math.nan)
                low, high = sorted(float(c) * k for c in ci)
                true = value
                if high < 0 < true or true < 0 < low:  # the sign of a clock is a convention
                    true = -true
                near = true and 0.1 < abs(par["value"] * k / true) < 10
                if near or far_off:
                    rows.append(
                        {"effect": truth["name"], "figure": quantity, "true": value, "said": par["value"] * k,
                         "ci95": [low, high], "covered": low <= true <= high}
                    )  # fmt: skip
                    break
    return rows


def score(
    answer: Mapping[str, Any], report: Mapping[str, Any], oracle: Mapping[str, float] | None = None
) -> dict[str, Any]:
    """Return a row of the result. ``oracle``: the noise rms on the held-out samples, if the report names them."""
    verdict = str(report.get("verdict", "error"))
    named = names_of(report)
    true = [t["name"] for t in answer["effects"] if t["name"] != "unknown"]
    location = report.get("location") or {}
    follows = [str(d.get("signal")) for d in location.get("depends_on") or []]
    row: dict[str, Any] = {
        "kind": answer["kind"], "twin": answer["twin"], "severity": answer["severity"],
        "excitation": answer["excitation"], "true": true, "form": [t["form"] for t in answer["effects"]],
        "noise_kind": answer["noise_kind"], "verdict": verdict, "said": named, "follows": follows[:3],
        "error": report.get("error"), "tool_seconds": report.get("seconds"),
    }  # fmt: skip
    kind = answer["kind"]
    if kind in ("agrees", "recalibrate"):
        row["false_alarm"] = verdict in FALSE_ALARM or verdict == "error"
        row["ok"] = verdict == kind
        outputs = list(answer["noise_rms"])
    elif kind == "unknown":
        truth = answer["effects"][0]
        row["ok"] = verdict == "unexplained" and bool(follows) and follows[0] in truth["depends"]
        row["unexplained"] = verdict == "unexplained"
        row["decoy_first"] = bool(follows) and follows[0] in answer["decoys"]
        outputs = truth["outputs"]
    else:
        outputs = sorted({o for t in answer["effects"] for o in t["outputs"]})
        if kind == "single":
            row["ok"] = bool(named) and named[0] == true[0]
            row["in_group"] = bool(named) and true[0] in _group(report, named[0])
        else:
            row["ok"] = set(true) <= set(named)
            group = set().union(*(_group(report, n) for n in named)) if named else set()
            row["in_group"] = set(true) <= group
        row["extra"] = [n for n in named if n not in true]
        row["outputs_ok"] = bool(location.get("outputs")) and location["outputs"][0] in outputs
        row["stage_ok"] = location.get("stage") in {s for t in answer["effects"] for s in t["stages"]}
        row["depends_ok"] = bool(follows) and follows[0] in {d for t in answer["effects"] for d in t["depends"]}
        if kind == "single":
            row["predictable"] = all(t["predictable"] for t in answer["effects"])
        row["coverage"] = coverage(report, answer)
    row |= fit_figures(report, answer, outputs, oracle)
    return row


def count_true(rows: Sequence[Mapping[str, Any]], key: str) -> list[int]:
    """Return in how many of ``rows`` the answer to ``key`` is true, and how many have an answer."""
    have = [r for r in rows if r.get(key) is not None]
    return [sum(bool(r[key]) for r in have), len(have)]


def summary(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Counts as [right, of]; the confusion table; weak classes by name."""
    single = [r for r in rows if r["kind"] == "single"]
    named = [r for r in single if r["ok"]]
    controls = [r for r in rows if r["kind"] in ("agrees", "recalibrate")]
    unknowns = [r for r in rows if r["kind"] == "unknown"]
    pairs = [r for r in rows if r["kind"] == "pair"]
    confusion: dict[str, dict[str, int]] = {}
    for r in single:
        to = r["said"][0] if r["said"] else r["verdict"]
        confusion.setdefault(r["true"][0], {}).setdefault(to, 0)
        confusion[r["true"][0]][to] += 1
    by_class: dict[str, dict[str, list[int]]] = {}
    for r in single:
        cell = by_class.setdefault(r["true"][0], {}).setdefault(f"{r['severity']:g}", [0, 0])
        cell[0] += bool(r["ok"])
        cell[1] += 1
    weak = {
        name: [sum(c[0] for k, c in cells.items()), sum(c[1] for k, c in cells.items())]
        for name, cells in by_class.items()
        if any(c[0] < c[1] for c in cells.values())
    }
    foreseeable = [r for r in named if r.get("predictable") and r["explained"] is not None]
    cover = [c for r in single + pairs for c in r.get("coverage") or []]
    cpu_s = sorted(r["cpu_s"] for r in rows if r.get("cpu_s") is not None)
    return {
        "cases": len(rows),
        "named_severity_4_up": count_true([r for r in single if r["severity"] >= 4], "ok"),
        "named_severity_2": count_true([r for r in single if r["severity"] < 4], "ok"),
        "named_in_equivalence_group": count_true(single, "in_group"),
        "extra_names": [sum(len(r["extra"]) > 0 for r in single), len(single)],
        "pairs_both_named": count_true(pairs, "ok"),
        "false_alarms": count_true(controls, "false_alarm"),
        "controls_verdict_right": count_true(controls, "ok"),
        "unknown_unexplained": count_true(unknowns, "unexplained"),
        "unknown_with_right_signal": count_true(unknowns, "ok"),
        "output_right": count_true(single + pairs, "outputs_ok"),
        "stage_right": count_true(single + pairs, "stage_ok"),
        "depends_right": count_true(single + pairs, "depends_ok"),
        "explained_90_percent": [sum(r["explained"] >= 0.9 for r in foreseeable), len(foreseeable)],
        "below_noise": count_true([r for r in rows if r["ratio"] is not None], "below_noise"),
        "ci_coverage": [sum(c["covered"] for c in cover), len(cover)],
        "errors": [sum(bool(r.get("error")) for r in rows), len(rows)],
        "cpu_s_median": cpu_s[len(cpu_s) // 2] if cpu_s else None,
        "cpu_s_max": cpu_s[-1] if cpu_s else None,
        "cpu_s_total": round(sum(cpu_s), 1),
        "by_class": by_class,
        "confusion": confusion,
        "weak_classes": weak,
    }
