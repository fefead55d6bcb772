"""Section 5 of contracts/recordings-and-mismatch.md spelled out by hand: what is wrong with a report's JSON."""

import math

from tests.unit.vocabulary import NAMES

VERDICTS = ("agrees", "recalibrate", "missing_physics", "unexplained")
STAGES = ("actuator", "amplifier", "sensor", "mounting", "acquisition", "environment", "mechanics")
TOP = {
    "format": int,
    "recording": str,
    "verdict": str,
    "summary": str,
    "location": dict,
    "physics": list,
    "alternatives": list,
    "equivalent": list,
    "detection_limit": dict,
    "fit": dict,
    "checks": dict,
    "seconds": (int, float),
}


def faults(r: dict) -> list[str]:
    """Every departure from the contract, in words; [] for a good report."""
    out: list[str] = []

    def need(ok: bool, what: str) -> None:
        if not ok:
            out.append(what)

    for key, kind in TOP.items():
        need(key in r, f"no {key}")
        need(isinstance(r.get(key), kind) and not isinstance(r.get(key), bool), f"{key} is {r.get(key)!r}")
    if out:
        return out
    need(r["format"] == 1, "format")
    need(r["verdict"] in VERDICTS, "verdict")
    need(r["summary"].strip() != "" and r["summary"].strip().endswith("."), "summary is no sentence")
    need(_number(r["seconds"]) and r["seconds"] >= 0, "seconds")
    outputs = list(r["fit"].get("unit", {}))
    out += _location(r["location"], r["verdict"], outputs)
    for i, p in enumerate(r["physics"]):
        out += [f"physics {i}: {f}" for f in _physics(p, outputs)]
    for a in r["alternatives"]:
        need(a.get("name") in NAMES, "alternative's name")
        need(_number(a.get("residual_rms_after")), "alternative's residual")
        need(bool(a.get("why_not")), "alternative's why_not")
    for e in r["equivalent"]:
        need(len(e.get("names", [])) >= 2 and all(n in NAMES for n in e["names"]), "equivalent's names")
        need(bool(e.get("tell_apart_by")), "equivalent's tell_apart_by")
    need(set(r["detection_limit"]) == set(outputs), "detection_limit is not per output")
    for of in r["detection_limit"].values():
        need(all(n in NAMES for n in of), "detection_limit names an unknown effect")
        need(all(_number(v) and v > 0 for v in of.values()), "detection_limit is not a positive rms")
    out += _fit(r["fit"], outputs)
    c = r["checks"]
    need(isinstance(c.get("residual_white_before"), bool), "residual_white_before")
    need(isinstance(c.get("residual_white_after"), bool), "residual_white_after")
    p = c.get("false_alarm_p_value")
    need(_number(p) and 0 <= p <= 1, "false_alarm_p_value")
    if r["verdict"] in ("agrees", "recalibrate"):
        need(r["physics"] == [], f"{r['verdict']} with physics")
        need(any(r["detection_limit"].values()), f"{r['verdict']} without any detection limit says nothing")
    if r["verdict"] == "missing_physics":
        need(len(r["physics"]) >= 1, "missing_physics without physics")
    return out


def _location(loc: dict, verdict: str, outputs: list[str]) -> list[str]:
    out = []
    found = verdict in ("missing_physics", "unexplained")
    if not isinstance(loc.get("outputs"), list) or not all(o in outputs for o in loc["outputs"]):
        out.append("location.outputs")
    elif found and not loc["outputs"]:
        out.append("location.outputs is empty")
    if loc.get("stage") not in STAGES and (found or loc.get("stage") != ""):
        out.append(f"location.stage is {loc.get('stage')!r}")
    for w in loc.get("windows", [None]):
        if not (isinstance(w, dict) and _number(w.get("start_s")) and w["start_s"] < w.get("stop_s", -1)):
            out.append("location.windows")
    if not isinstance(loc.get("regime"), str) or not loc["regime"]:
        out.append("location.regime")
    for d in loc.get("depends_on", [None]):
        if not (isinstance(d, dict) and d.get("signal") and d.get("feature") and 0 <= d.get("strength", -1) <= 1):
            out.append("location.depends_on")
    return out


def _physics(p: dict, outputs: list[str]) -> list[str]:
    out = []
    if p.get("name") not in NAMES:
        out.append(f"name {p.get('name')!r}")
    if p.get("output") not in outputs:
        out.append("output")
    if p.get("stage") not in STAGES:
        out.append("stage")
    if not 0 <= p.get("confidence", -1) <= 1:
        out.append("confidence")
    for name, v in p.get("parameters", {"": {}}).items():
        ci = v.get("ci95", [])
        if not (name and _number(v.get("value")) and isinstance(v.get("unit"), str) and len(ci) == 2):
            out.append(f"parameter {name}")
        elif all(map(_number, ci)) and not ci[0] <= v["value"] <= ci[1]:
            out.append(f"parameter {name} outside its interval")
    out += [k for k in ("equation", "source") if not p.get(k)]
    out += [k for k in ("residual_rms_before", "residual_rms_after") if not _number(p.get(k))]
    return out


def _fit(fit: dict, outputs: list[str]) -> list[str]:
    out = [] if outputs else ["fit.unit is empty"]
    if fit.get("held_out") is not True:
        out.append("fit.held_out")
    for key in ("base_rms", "recalibrated_rms", "fitted_rms", "noise_floor_rms"):
        values = fit.get(key, {})
        if set(values) != set(outputs) or not all(_number(v) and v >= 0 for v in values.values()):
            out.append(f"fit.{key}")
    return out


def _number(v: object) -> bool:
    return isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v)
