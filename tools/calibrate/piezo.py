"""Model of a piezo stack from recordings of drive and displacement (Ang 2004, 7.2.3, 7.3.2; errata 74-79).

Saw-teeth and sinusoids of different rates and sizes go in together. In order: how the displacement lags (a delay, or
amplifier lag and resonance); which thresholds and which parts (dead zones, rate-dependent slopes and where their law
is held, creep) predict recordings that were left out; all parameters by one bounded least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar
from threadpoolctl import threadpool_limits

from hal.arrays import Array
from tools.calibrate.calibration_file import calibration_toml
from tools.calibrate.piezo_dynamics import MAX_LAG_S, Dynamics, delayed, fit_dynamics
from tools.calibrate.piezo_excitation import determined_from, missing, one_loop
from tools.calibrate.piezo_feedforward import Answers, Feedforward, for_tip
from tools.calibrate.piezo_fit import PiezoFit
from tools.calibrate.piezo_prediction import simulate
from tools.calibrate.piezo_regression import Axes, Piece, Shape, Solution, axes_of, fit, play_states, residual, stack_of
from tools.calibrate.piezo_start import begins_with_step, fit_lag, from_rest
from tools.calibrate.piezo_steps import fit_steps, is_steps
from tools.errors import InputError
from tools.mismatch.recording import Recording

# fine where a tremor's small loops run, coarse beyond (Ang 2004, 7.2.1); fractions of half the drive's range
FAMILIES: dict[str, tuple[float, ...]] = {
    "8 plays": (0.0, 0.03, 0.08, 0.16, 0.28, 0.44, 0.64, 0.88),
    "10 plays, Ang 2004": (0.0, 0.08, 0.16, 0.24, 0.32, 0.4, 0.5, 0.62, 0.76, 0.9),
    "12 plays": (0.0, 0.02, 0.05, 0.09, 0.15, 0.22, 0.31, 0.41, 0.52, 0.64, 0.78, 0.93),
    "16 plays": (0.0, 0.01, 0.02, 0.04, 0.07, 0.11, 0.16, 0.22, 0.29, 0.37, 0.46, 0.56, 0.66, 0.76, 0.86, 0.95),
}
ZONES = ((0.35, 0.6, 0.8), (0.5, 0.7, 0.85), (0.2, 0.35, 0.5, 0.65, 0.8), (0.15, 0.25, 0.35, 0.45, 0.55, 0.68, 0.84))
CREEP_TIMES_S = (0.1, 1.0, 10.0)
LEAST_GAIN = 0.99  # a part stays when it brings the unseen error below this share
FIT_SHARE = 0.7


def identify_stack(recordings: Recording | Sequence[Recording]) -> PiezoFit:
    """Fit one stack to recordings of kind ``piezo_stack``. Raises ``InputError`` when it cannot be.

    The linear algebra uses one thread: the matrices are narrow, and a second thread waits more than it works.
    """
    with threadpool_limits(1):
        return _identify_stack(recordings)


def _identify_stack(recordings: Recording | Sequence[Recording]) -> PiezoFit:
    given = [recordings] if isinstance(recordings, Recording) else list(recordings)
    if not given:
        raise InputError("no recording was given; name at least one folder with a recording of the stack")
    steps = [r for r in given if is_steps(r)]
    given = [r for r in given if not is_steps(r)]
    if not given:
        raise InputError(f"{steps[0].path}: steps show lag and resonance only; add saw-teeth and sinusoids")
    dt = given[0].dt
    notes: list[str] = []
    for recording in given:
        _check(recording, dt)
    drives = [r.inputs["command"] for r in given]
    zs = [r.outputs["displacement"] for r in given]
    rows = [slice(determined_from(u), len(u)) for u in drives]
    if len(given) == 1:
        pieces = _halves(drives[0], zs[0], rows[0], dt)
    else:
        pieces = [Piece(u, z, np.zeros(len(u)), s, dt, np.ones(1)) for u, z, s in zip(drives, zs, rows, strict=True)]
    folds = [[i] for i in range(len(pieces))] if len(given) > 1 else [[1]]
    held = all(r.twin.parameters.get("hold") == "zero" for r in given) and dt < 2.5e-3

    centre_V = 0.5 * (min(u.min() for u in drives) + max(u.max() for u in drives))
    basic = Shape(FAMILIES["8 plays"])
    dynamics = Dynamics()
    # on loops of one size and rate a lag is just a wider loop
    if len(given) == 1 and one_loop(drives) and begins_with_step(drives[0], zs[0], dt):
        notes.append("all loops are alike; the lag is that of the step from 0 V with which the recording begins")
        whole = replace(pieces[0], rows=slice(0, pieces[0].rows.stop))
        pieces, dynamics = fit_lag([from_rest(p) for p in (whole, pieces[1])], replace(basic, zones=ZONES[0]), centre_V)
    elif one_loop(drives):
        notes.append("all loops are alike, so a lag cannot be told from hysteresis: taken as none")
    else:
        pieces, dynamics = _lag(pieces, basic, centre_V)
    pieces = rates_of(pieces, basic, centre_V)
    shape, axes, _, _, parts = _select(pieces, folds, centre_V, not one_loop(drives))
    if held:
        better, mode = _mode(pieces, drives, len(given) == 1, shape, axes)
        before = float(np.nanmean(fit(pieces, shape, axes, folds)[1]))
        after = float(np.nanmean(fit(better, shape, axes, folds)[1]))
        parts = (*parts, ("amplifier lag and resonance", after, after < before))
        if after < before:
            pieces, dynamics = better, mode
            pieces = rates_of(pieces, basic, centre_V)
            shape, axes, _, _, again = _select(pieces, folds, centre_V, not one_loop(drives))
            parts = (*parts, *again)
    partials: list[Solution] = []
    solution, unseen = fit(pieces, shape, axes, folds, partials)
    if steps:
        mechanism = fit_steps(steps[0])
        more_s = dynamics.sampled_delay_s(dt) - mechanism.sampled_delay_s(dt)
        answer = Answers(mechanism, mechanism, more_s, dt)
    else:
        answer = Answers(dynamics.mechanism(dt, held), dynamics, 0.0, dt)
    return _report(
        given, pieces, shape, axes, solution, unseen,
        dynamics=dynamics, parts=parts, notes=notes, partials=partials, answer=answer,
    )  # fmt: skip


def _check(recording: Recording, dt: float) -> None:
    where = recording.path
    if "command" not in recording.inputs or "displacement" not in recording.outputs:
        raise InputError(f"{where}: a piezo calibration needs channels with signals 'command' and 'displacement'")
    if abs(recording.dt - dt) > 1e-9:
        raise InputError(f"{where}: {1.0 / recording.dt:g} Hz, the first recording has {1.0 / dt:g} Hz; use one rate")
    drive = recording.inputs["command"]
    usable = len(drive) - determined_from(drive)
    if np.ptp(drive) <= 0.0 or usable < 280:
        raise InputError(
            f"{where}: the drive must visit its lowest and highest value early and then go on for a while; "
            f"only {max(0, usable)} of {len(drive)} samples can be fitted"
        )


def _halves(drive: Array, z: Array, rows: slice, dt: float) -> list[Piece]:
    """A single recording as what is fitted and what is held out; both are simulated from its start."""
    stop = max(rows.start + 1, round(FIT_SHARE * len(drive)))
    nothing, one = np.zeros(len(drive)), np.ones(1)
    return [
        Piece(drive, z, nothing, slice(rows.start, stop), dt, one),
        Piece(drive, z, nothing, slice(stop, len(drive)), dt, one),
    ]


def _lag(pieces: list[Piece], shape: Shape, centre_V: float) -> tuple[list[Piece], Dynamics]:
    """The delay of the drive that a rate-independent model explains best; zero unless it matters."""

    def shifted(lag_s: float) -> list[Piece]:
        return [replace(p, drive=delayed(p.drive, lag_s, p.dt)) for p in pieces]

    def misfit(lag_s: float) -> float:
        # every second sample is enough for one number
        few = [replace(p, rows=slice(p.rows.start, p.rows.stop, 2)) for p in shifted(lag_s)]
        axes = axes_of(few, shape, centre_V)
        solution, _ = fit(few, shape, axes, [])
        return float(np.mean([np.var(residual(p, shape, axes, solution)) for p in few]))

    minimum: Any = minimize_scalar(misfit, bounds=(0.0, MAX_LAG_S), method="bounded", options={"xatol": 2e-5})
    lag_s = float(minimum.x)
    if misfit(0.0) < 1.04 * misfit(lag_s):
        lag_s = 0.0
    return shifted(lag_s), Dynamics(delay_s=lag_s)


def _levels(drive: Array, shape: Shape, axes: Axes, solution: Solution) -> Array:
    """Strokes um of the rate-independent model, held drive, zones left out: good enough for rates and dynamics."""
    steps = np.diff(solution.rest, prepend=0.0)
    return play_states(drive, axes.r, axes.centre_V) @ steps


def rates_of(pieces: list[Piece], shape: Shape, centre_V: float) -> list[Piece]:
    """Rate of the wanted displacement in each sample, um/s: free of noise, from a rate-independent model."""
    axes = axes_of(pieces, shape, centre_V)
    solution, _ = fit(pieces, shape, axes, [])
    return [replace(p, rate=rate_of(_levels(p.drive, shape, axes, solution), p.dt)) for p in pieces]


def rate_of(x: Array, dt: float) -> Array:
    """Return |dx/dt| (n,) by backward difference (Ang 2004, eq. 7.16)."""
    return np.abs(np.diff(x, prepend=x[0])) / dt


def _select(
    pieces: list[Piece], folds: list[list[int]], centre_V: float, by_rate: bool
) -> tuple[Shape, Axes, Solution, float, tuple[tuple[str, float, bool], ...]]:
    """Thresholds and parts by what they leave in recordings that were not seen.

    ``by_rate``: whether a law of the rate is tried. Where all loops are alike the rate only tells where in the loop
    a sample is.
    """

    def score(shape: Shape) -> tuple[Axes, Solution, float]:
        axes = axes_of(pieces, shape, centre_V)
        solution, unseen = fit(pieces, shape, axes, folds)
        return axes, solution, float(np.nanmean(unseen))

    tried: list[tuple[str, float, bool]] = []
    shape = Shape(FAMILIES["8 plays"])
    axes, solution, best = score(shape)
    tried.append(("8 plays", best, True))
    families = [(name, {"plays": fractions}) for name, fractions in FAMILIES.items()]
    zones = [(f"dead zones at {', '.join(map(str, at))}", {"zones": at}) for at in ZONES]
    steps: list[tuple[str, dict[str, Any]]] = [
        *families,
        *zones,
        ("slopes by rate", {"rate": True}),
        ("creep", {"creep_times_s": CREEP_TIMES_S}),
        ("law held below 20 um/s", {"rate_low_um_per_s": 20.0}),
        ("law of the first two slopes held above 200 um/s", {"rate_high_um_per_s": 200.0}),
        # again: what the thresholds had to make up for may have been something else
        *zones,
        *families,
    ]
    for name, change in steps:
        if (name.startswith("law") and not shape.rate) or (name == "slopes by rate" and not by_rate):
            continue
        candidate = replace(shape, **change)
        if candidate == shape:
            continue
        scored = score(candidate)
        better = scored[2] < LEAST_GAIN * best
        tried.append((name, scored[2], better))
        if better:
            shape = candidate
            axes, solution, best = scored
    return shape, axes, solution, best, tuple(tried)


def _mode(
    pieces: list[Piece], drives: list[Array], single: bool, shape: Shape, axes: Axes
) -> tuple[list[Piece], Dynamics]:
    """The same pieces with the undelayed drive and the answer to held demands, and its parameters."""
    held = [replace(p, drive=drives[0 if single else i]) for i, p in enumerate(pieces)]
    solution, _ = fit(pieces, shape, axes, [])
    stack = stack_of(solution, shape, axes, 0.0)
    levels = [simulate(stack, p.drive, 1.0 / p.dt, float(p.drive.max())) for p in held]
    dt = pieces[0].dt
    dynamics = fit_dynamics(levels, [p.z for p in held], dt, [p.rows for p in held])
    return [replace(p, response=dynamics.response(dt)) for p in held], dynamics


def _report(
    given: list[Recording],
    pieces: list[Piece],
    shape: Shape,
    axes: Axes,
    solution: Solution,
    unseen: Array,
    *,
    dynamics: Dynamics,
    parts: tuple[tuple[str, float, bool], ...],
    notes: list[str],
    partials: list[Solution],
    answer: Answers,
) -> PiezoFit:
    raw = [residual(p, shape, axes, solution) for p in pieces]
    errors = [e - e.mean() for e in raw]
    zero = float(np.mean([e.mean() for e in raw]))
    judged = [i for i in range(len(pieces)) if np.isfinite(unseen[i])]
    lines = []
    for p in pieces:
        u, z = p.drive[p.rows], p.z[p.rows]
        lines.append(np.mean((z - np.polyval(np.polyfit(u, z, 1), u)) ** 2))
    names = [r.path.name if r.path.suffix == "" else r.path.stem for r in given]
    if len(set(names)) < len(names):
        names = [f"{name} {i + 1}" for i, name in enumerate(names)]
    if len(given) == 1:
        names = [f"{names[0]} (first {FIT_SHARE:.0%})", f"{names[0]} (rest)"]
    return PiezoFit(
        stack=stack_of(solution, shape, axes, zero),
        others=tuple(stack_of(partial, shape, axes, zero) for partial in partials),
        tick_hz=1.0 / given[0].dt,
        low_V=min(float(r.inputs["command"].min()) for r in given),
        high_V=max(float(r.inputs["command"].max()) for r in given),
        span_um=(min(float(p.z[p.rows].min()) for p in pieces), max(float(p.z[p.rows].max()) for p in pieces)),
        answer=answer,
        dynamics=dynamics,
        lag_s=dynamics.sampled_delay_s(given[0].dt),
        rms_um=float(np.sqrt(np.mean([np.mean(e**2) for e in errors]))),
        held_out_rms_um=float(np.sqrt(np.mean(unseen[judged] ** 2))),
        held_out_max_um=max(float(np.max(np.abs(errors[i]))) for i in judged),
        linear_rms_um=float(np.sqrt(np.mean(lines))),
        range_um=axes.span_um,
        top_rate_um_s=axes.top_rate,
        unseen_um={names[i]: float(unseen[i]) for i in judged},
        parts=parts,
        warnings=(
            *notes,
            *missing(
                [r.inputs["command"] for r in given], [p.rate[p.rows] for p in pieces], [r.n * r.dt for r in given]
            ),
        ),
    )


def feedforward_of(fits: Sequence[PiezoFit], tick_hz: float = 1000.0) -> Feedforward:
    """Return taps and preview of these stacks for a firmware of ``tick_hz``."""
    return for_tip([fit.answer for fit in fits], 1.0 / tick_hz)


def piezo_calibration(fits: Sequence[PiezoFit], title: str, tick_hz: float = 1000.0) -> str:
    """Return the calibration file for the firmware, from one fit for all stacks or one per stack in order 1, 2, 3."""
    if len(fits) not in (1, 3):
        raise InputError(f"{len(fits)} stacks: give recordings of one (for all three stacks) or three (1, 2, 3)")
    stacks: list[dict[str, Any]] = [
        {key: list(v) if isinstance(v, tuple) else v for key, v in fit.stack.model_dump().items()} for fit in fits
    ]
    inverse = feedforward_of(fits, tick_hz)
    times = 3 // len(stacks)
    table: dict[str, Any] = {
        "preview_s": inverse.preview_s,
        "feedforward": [[round(v, 6) for v in taps] for taps in inverse.taps] * times,
        "stacks": stacks * times,
    }
    return calibration_toml(title, "micron calibrate piezo", {"actuation": table})
