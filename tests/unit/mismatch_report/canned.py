"""Reports of every verdict, made by hand: a stack with creep, two axes, and what else a report can hold."""

from dataclasses import replace

import numpy as np

from tools.mismatch.engine.report import (
    Alternative,
    BaseShift,
    Checks,
    DependsOn,
    Equivalent,
    FitSummary,
    Location,
    ParameterValue,
    PhysicsFound,
    Pictures,
    Report,
    Window,
)

CHAIN = ("amplifier", "actuator", "mechanics", "environment", "sensor", "acquisition")


def pictures(n: int = 600) -> Pictures:
    """A sine with a slow residual; the third and fifth sixth are held out; ten samples in front of them are gaps."""
    rng = np.random.default_rng(3)
    keep = np.ones(n, bool)
    held = np.zeros(n, bool)
    for k in (2, 4):
        keep[k * n // 6 - 10 : k * n // 6] = False
        held[k * n // 6 : (k + 1) * n // 6] = True
    t = np.arange(n) * 0.01
    u = 50 + 40 * np.sin(2 * np.pi * 0.7 * t)
    y = 0.125 * u + 0.4 * (1 - np.exp(-t)) + rng.normal(0, 0.02, n)
    arrays = {k: v[keep] for k, v in {"t": t, "u": u, "y": y}.items()}
    given, fitted = 0.12 * arrays["u"], 0.125 * arrays["u"] + 0.4 * (1 - np.exp(-arrays["t"]))
    return Pictures(
        arrays["t"],
        held[keep],
        {"displacement": arrays["y"]},
        {"displacement": given},
        {"displacement": 0.126 * arrays["u"] + 0.3},
        {"displacement": fitted},
        {"command": arrays["u"]},
    )


def creep() -> PhysicsFound:
    return PhysicsFound(
        "creep",
        "displacement",
        "actuator",
        0.97,
        {
            "fraction_per_decade": ParameterValue(0.0213, "1", (0.019, 0.0236)),
            "mean_time_constant_s": ParameterValue(1.3, "s", (0.2, 2.4)),
        },
        r"y = x + \sum_j c_j z_j,\quad \tau_j \dot z_j = x - z_j",
        "K. Kuhnen, 2003 <eq. 6> & others",
        0.41,
        0.023,
        "output",
        "displacement",
        ("displacement",),
        {"time_constants_s": (0.1, 1.0, 10.0), "rest_range": (0.0, 90.0), "first": (50.0,)},
        {"rest": 50.0, "c1": 0.001, "c2": 0.004, "c3": 0.002},
        note="input or output",
        at_bound=("creep[displacement].rest",),
    )


def missing_physics() -> Report:
    return Report(
        recording="/data/stack/recording.toml",
        twin="piezo_stack",
        verdict="missing_physics",
        summary="The simulation lacks creep at the actuator (displacement): 0.41 falls to 0.023 um.",
        location=Location(
            ("displacement",),
            "actuator",
            (Window(0.0, 3.5), Window(4.0, 6.0)),
            "worst late in the record (1.8 times)",
            (DependsOn("command", "recent history", 0.83, 1e-12, True), DependsOn("time", "time itself", 0.4)),
        ),
        physics=(creep(),),
        alternatives=(Alternative("thermal_drift", "displacement", 0.19, "leaves 8.3 times the residual of creep"),),
        equivalent=(Equivalent(("creep", "ac_coupling"), "two steps of opposite sign"),),
        detection_limit={"displacement": {"creep": 0.03, "resonance": 0.02, "backlash": 0.05, "dead_time": 0.4}},
        cannot_show={"spikes": "none; the longer the record, the more events"},
        fit=FitSummary(
            {"displacement": "um"},
            True,
            {"displacement": 0.55},
            {"displacement": 0.41},
            {"displacement": 0.023},
            {"displacement": 0.02},
            {"displacement": "spectrum"},
            ((0, 190), (300, 390)),
            ((200, 300), (400, 500)),
            (BaseShift("gain_um_per_V", "um/V", 0.12, 0.126, 0.125, (0.1249, 0.1251)),),
        ),
        checks=Checks(False, True, 1e-9, ("displacement sits at its exact limits in 12 samples",), 1e-5),
        seconds=8.4,
        seed=0,
        chain=CHAIN,
        corrected_base={"gain_um_per_V": 0.125, "offset_um": 0.0},
        pictures=pictures(),
    )


def agrees() -> Report:
    good = missing_physics()
    quiet = {k: {"displacement": 0.02} for k in ("base_rms", "recalibrated_rms", "fitted_rms", "noise_floor_rms")}
    return replace(
        good,
        verdict="agrees",
        summary="The recording is within its noise of the simulation as given.",
        location=Location((), "", (), "nowhere", ()),
        physics=(),
        alternatives=(),
        equivalent=(),
        fit=replace(good.fit, **quiet, noise_method={"displacement": "declared"}),
        checks=Checks(True, True, 1.0),
        cannot_show={"saturation": "amplitudes that reach the limits, and smaller ones for comparison"},
    )


def recalibrate() -> Report:
    r = agrees()
    return replace(
        r,
        verdict="recalibrate",
        summary="New base parameters explain the recording; no physics is missing.",
        fit=replace(r.fit, base_rms={"displacement": 0.5}),
    )


def unexplained() -> Report:
    r = missing_physics()
    return replace(
        r,
        verdict="unexplained",
        summary="Something is left in displacement that no known effect explains and follows command (rate).",
        location=replace(r.location, stage="mechanics", depends_on=(DependsOn("command", "rate", 0.6),)),
        physics=(),
        alternatives=(),
        equivalent=(),
        fit=replace(r.fit, fitted_rms=r.fit.recalibrated_rms),
    )


def all_verdicts() -> dict[str, Report]:
    return {r.verdict: r for r in (agrees(), recalibrate(), missing_physics(), unexplained())}
