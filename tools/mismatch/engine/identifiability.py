"""Determines the limits of a recording: indistinguishable effects, invisible effects, detection limits."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hal.arrays import Array
from sim_devices.physics.effect import Effect
from tools.mismatch.engine.colour import Whitener, whiten
from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.screen import places
from tools.mismatch.placed import Placed
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_start import prepare
from tools.mismatch.simulate_start import starts as starts_of

EXPERIMENTS: dict[frozenset[str], str] = {
    frozenset(a.split()): b
    for a, b in (
        ("creep thermal_drift", "record the temperature, or two steps of opposite sign"),
        ("creep random_walk", "the same input twice: creep repeats, a walk does not"),
        ("creep first_order_lag", "hold after a step for a thousand times longer than it takes to rise"),
        ("creep rate_dependent_hysteresis", "hold after a step, and triangles at two speeds a hundred times apart"),
        ("creep hysteresis", "the same triangle at two speeds a hundred times apart"),
        ("backlash hysteresis", "triangles of several amplitudes: play keeps its width, a loop grows"),
        ("backlash rate_dependent_hysteresis", "triangles of several amplitudes and speeds"),
        ("backlash coulomb_friction", "reversals at two stiffnesses or loads; record the force"),
        ("hysteresis rate_dependent_hysteresis", "the same triangle at two speeds a hundred times apart"),
        ("hysteresis first_order_lag", "the same triangle at two speeds: a lag's loop vanishes when slow"),
        ("first_order_lag rate_dependent_hysteresis", "a slow triangle: a lag's loop vanishes"),
        (
            "first_order_lag dead_time",
            "frequencies up to a tenth of the sampling rate: a lag attenuates, a delay does not",
        ),
        ("first_order_lag resonance", "a chirp through the mode"),
        ("dead_time resonance", "a chirp up to the mode"),
        ("dead_time clock_skew", "a longer recording: skew grows with time"),
        ("dead_time channel_delay", "two channels that see the same motion"),
        ("dead_time dropped_samples", "a recording with a counter of samples"),
        ("clock_skew dropped_samples", "a counter or time stamp on either side"),
        ("thermal_drift random_walk", "the same warm-up twice: drift repeats"),
        ("thermal_drift step_shift", "a longer recording"),
        ("thermal_drift temperature_sensitivity", "a temperature that goes up and comes down"),
        ("temperature_sensitivity random_walk", "a second temperature cycle"),
        ("saturation static_nonlinearity", "larger amplitudes: a limit clips, curvature goes on"),
        ("dead_zone static_nonlinearity", "small amplitudes around zero"),
        ("dead_zone backlash", "a bias under the small motion: a dead zone stays at zero, play follows"),
        ("misalignment soft_iron", "turn the sensor about two axes in a field of known direction"),
        ("misalignment sensor_position_error", "translate without turning, then turn without translating"),
        ("centripetal_acceleration sensor_position_error", "steady rotation, then angular acceleration alone"),
        ("cross_axis_nonlinearity scale_factor_variation", "tumble with one axis held at zero"),
        ("cross_axis_nonlinearity static_nonlinearity", "drive one axis while the other rests"),
        ("mains_interference vibration", "switch the mains-fed devices off, or shift the speed of the machine"),
        ("vibration resonance", "rest without input: an outside vibration goes on"),
        ("coulomb_friction stribeck_friction", "very slow motion with many reversals"),
        ("slew_limit first_order_lag", "steps of two sizes: a slew limit takes longer for the larger"),
        ("slew_limit saturation", "slow large amplitudes, then fast small ones"),
    )
}


def experiment(a: Effect, b: Effect) -> str:
    """Return the recording that would split two effects."""
    known = EXPERIMENTS.get(frozenset((a.name, b.name)))
    if known:
        return known
    return f"{a.name}: {a.excitation}; {b.name}: {b.excitation}"


@dataclass(frozen=True)
class LeastNamed:
    """Holds the thresholds for naming an effect of one parameter on one output.

    ``z`` is that of its test; ``gain`` is a share of the held-out mean square.
    """

    z: float
    gain: float


@dataclass(frozen=True)
class Limits:
    """Holds the detection limits of a recording.

    ``limit[output][effect]`` is the smallest effect rms in the output's unit that would have been named; ``cannot``
    lists the effects that the excitation cannot show, with the requirement on a recording.
    """

    limit: dict[str, dict[str, float]]
    cannot: dict[str, str]


def directions(
    problem: Problem, current: Fit, placed: Placed, starts: Sequence[Array] | None = None, most: int = 3
) -> list[dict[str, Array]]:
    """Return the response of the simulated outputs to a weak effect: per start and weight, output -> (m,)."""
    model = Model(problem.twin, (*current.model.placed, placed))
    theta = model.carry(current.model, current.theta, problem.recording)
    out: list[dict[str, Array]] = []
    weights = model.slices(len(model.placed) - 1)[1]
    if not starts or starts[0].size != theta.size:
        starts = starts_of(model, len(model.placed) - 1, problem.fit_view, theta)
    for start in starts[:most]:
        if weights.stop > weights.start:
            design = model.design(problem.view, start, placed.outputs)
            for j in range(weights.start, weights.stop):
                move = {
                    o: design.columns[o][:, design.linear[o].index(j)] for o in placed.outputs if j in design.linear[o]
                }
                if move:
                    out.append(move)
            if not out:
                before = model.simulate(problem.view, start, placed.outputs)
                for j in range(weights.start, weights.stop):
                    pushed = start.copy()
                    pushed[j] += model.parameters[j].scale * 1e-3
                    after = model.simulate(problem.view, pushed, placed.outputs)
                    out.append({o: after[o] - before[o] for o in after})
        else:
            after = model.simulate(problem.view, start, placed.outputs)
            out.append({o: after[o] - (problem.measured[o] - current.residual[o]) for o in after})
    return out


def detection(
    problem: Problem,
    current: Fit,
    effects: Iterable[Effect],
    filters: dict[str, Whitener],
    least: LeastNamed,
    *,
    known: Mapping[tuple[str, ...], tuple[Placed, Sequence[Array]]] | None = None,
) -> Limits:
    """Return the smallest effect rms per output and effect that would have been named beside ``current``.

    It follows from the noncentrality of the held-out score test at its threshold (plus one standard deviation, so that
    it is named five times in six) and from the least gain, less the part that base parameters absorb. ``known``: places
    that were screened already, with their settings and starts, by (name, kind, site, target).
    """
    limit: dict[str, dict[str, float]] = {o: {} for o in problem.twin.outputs}
    cannot: dict[str, str] = {}
    base_design = current.model.design(problem.view, current.theta)
    rows = problem.held_rows[:: max(1, problem.held_rows.size // 20000)]
    q: dict[str, Array] = {}
    for o in problem.twin.outputs:
        columns = base_design.columns[o]
        inverse = np.linalg.pinv(columns[rows], rcond=1e-9) if columns.shape[1] else np.zeros((0, rows.size))
        q[o] = np.asarray(inverse, np.float64)
    for effect in effects:
        best: dict[str, float] = {}
        tried = False
        for place in places(problem, (effect,), ()):
            tried = True
            with np.errstate(all="ignore"):
                key = (effect.name, place.effect.kind, place.site, place.target)
                if known and key in known:
                    placed, starts = known[key]
                else:
                    placed, starts = prepare(current.model, problem.fit_view, current.theta, place), None
                moves = directions(problem, current, placed, starts)
            moves = moves[:: max(1, -(-len(moves) // 5))]
            for o in placed.outputs:
                values: list[float] = []
                for move in moves:
                    d = move.get(o)
                    if d is None or not np.all(np.isfinite(d)):
                        continue
                    size = float(np.std(d[rows]))
                    if size <= 1e-12 * max(float(np.max(np.abs(problem.measured[o]))), 1e-300):
                        continue
                    left = d.copy()
                    if q[o].shape[0]:
                        left = d - base_design.columns[o] @ (q[o] @ d[rows])
                    rest = float(np.sqrt(np.mean(left[rows] ** 2)))
                    if rest < 0.01 * size:
                        continue
                    moved = whiten(filters[o], left, problem.held_spans)
                    noise = max(filters[o].innovation_rms, 1e-300)
                    power = float(np.linalg.norm(moved)) / noise
                    by_test = (least.z + 1.0) * size / max(power, 1e-300)
                    by_gain = np.sqrt(least.gain / (1 - least.gain)) * problem.sigma(o) * size / rest
                    values.append(max(by_test, by_gain))
                if values:
                    value = float(np.median(values))
                    best[o] = min(best.get(o, np.inf), value)
        if not tried:
            continue
        if not best:
            cannot[effect.name] = effect.excitation
        for o, v in best.items():
            limit[o][effect.name] = v
    return Limits(limit, cannot)
