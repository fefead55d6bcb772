"""Prepares a recording for a search; after it, repeats the fits in one run through the whole record."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from sim_devices.physics.catalogue import EFFECTS
from sim_devices.physics.effect import Effect
from tools.mismatch.engine.fit import Fit, as_given, fit, fit_base
from tools.mismatch.engine.hold import infer_holds, with_hold
from tools.mismatch.engine.imitated import imitated
from tools.mismatch.engine.join import joined
from tools.mismatch.engine.many import levelled, repeated_noise
from tools.mismatch.engine.noise import noise_floor
from tools.mismatch.engine.partition import SAMPLES, split_inside, splittable
from tools.mismatch.engine.problem import Hint, Problem
from tools.mismatch.engine.reduce import OVER_ALL, SLOW, VERY_LONG, excerpt, fitted_part, is_long, part_of, thinned_copy
from tools.mismatch.engine.report import Hold
from tools.mismatch.engine.residual import residuals
from tools.mismatch.engine.score import misfit
from tools.mismatch.engine.screen import Candidate
from tools.mismatch.engine.split import Split, given_split, own_split, shot, split_of_parts
from tools.mismatch.engine.trust import broken, fit_loss, stayed
from tools.mismatch.input_noise import error_of_mean
from tools.mismatch.placed import Placed
from tools.mismatch.recording import Recording
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_view import View
from tools.mismatch.twins.base import Twin
from tools.mismatch.twins.cascade import CascadeTwin
from tools.mismatch.twins.corrected import CorrectedTwin
from tools.mismatch.twins.dynamic import DynamicTwin
from tools.mismatch.twins.fmu import with_equations
from tools.mismatch.twins.make import make
from tools.mismatch.twins.ode import OdeTwin, inside_of

Progress = Callable[[str, int, int], None]

UNKNOWN_START = 0.03
"""Share of a record at its start that is simulated and not scored. The unknown past before the record is still in the
memory of stacks, filters and masses there."""
LEAST_PART = 30  # least number of samples of a part that can be fitted or scored


def make_split(recording: Recording, held_out: float, seed: int, restart: bool) -> Split:
    """Return the recording's own split if it has one, else ours, with few segments for a twin that restarts in each."""
    given = ranges_of(recording)
    if given is not None:
        return given_split(recording.n, *given, initialization=recording.split.initialization or 0)
    signals = np.column_stack([*recording.signals.values()]) if recording.signals else np.empty((recording.n, 0))
    outputs = np.column_stack([*recording.outputs.values()])
    guard = max(4, recording.n // 2000)
    begin = 0 if restart else int(UNKNOWN_START * recording.n)
    if "x0" in recording.twin.parameters or recording.twin.kind in ("state_space", "mechanical_axis"):
        begin = before_the_blow(recording, begin)
    segments = 3 if restart else 6
    return own_split(signals, outputs, held_out=held_out, seed=seed, guard=guard, segments=segments, begin=begin)


LEAST_MOVED = 0.06
"""Largest share of an input's movement that may be lost with the start of a record."""


def before_the_blow(recording: Recording, begin: int) -> int:
    """Return the last sample up to ``begin`` before which the inputs hardly moved.

    A record whose excitation is at its start (a hammer blow, one step) would otherwise lose its information.
    """
    for x in recording.inputs.values():
        moved = np.cumsum(np.diff(x, prepend=x[0]) ** 2)
        if moved[-1] > 0:
            begin = min(begin, int(np.searchsorted(moved, LEAST_MOVED * moved[-1])))
    return max(0, begin - 1)


def ranges_of(recording: Recording) -> tuple[tuple[int, int], tuple[int, int]] | None:
    """Return the recording's fit and test range; if it has only one, the longer rest is the other. None: own split."""
    fit, test, n = recording.split.fit, recording.split.test, recording.n
    given = next((r for r in (test, fit) if isinstance(r, tuple)), None)
    if given is None:
        return None
    rest = max((0, given[0]), (given[1], n), key=lambda r: r[1] - r[0])
    span = fit if isinstance(fit, tuple) else rest
    held = test if isinstance(test, tuple) else rest
    return (span, held) if min(span[1] - span[0], held[1] - held[0]) >= LEAST_PART else None


def free_run(recording: Recording, twin: Twin) -> tuple[Twin, int]:
    """Choose how our own split simulates, and return the number of measured samples that set a start state.

    It is one run through the whole record if the inputs determine its course, else a restart at every range. Only a
    plant that integrates is restarted: with a spring or drag the start state decays within the record.
    """
    fastest_per_s = getattr(twin, "fastest_per_s", None)  # a corrected axis has this attribute, too
    if fastest_per_s is None:
        return twin, 0
    if twin.restart and any(p.name == "stiffness_per_mass" for p in twin.parameters):
        twin = restarting(twin, False)
    if "x0" in recording.twin.parameters and not twin.restart:
        return twin, 0
    period = 4.0 / max(fastest_per_s * recording.dt, 1e-9)
    most = recording.n // (150 if twin.restart else 25)
    return twin, int(np.clip(period, 40, max(most, 40)))


def restarting(twin: Twin, restart: bool) -> Twin:
    """Return a dynamic twin, plain or corrected, that restarts at every range or does not."""
    assert isinstance(twin, DynamicTwin | CorrectedTwin | OdeTwin | CascadeTwin)
    return replace(twin, restart=restart)


def set_floors(problem: Problem, base: Fit) -> Problem:
    """Return the noise floors from the recalibrated residual."""
    rec = problem.recording
    inputs = np.column_stack([*rec.inputs.values()]) if rec.inputs else np.empty((rec.n, 0))
    whole: dict[str, np.ndarray] = {}
    if not problem.twin.restart:
        with np.errstate(all="ignore"):
            simulated = base.model.simulate(View.whole(rec, problem.init), base.theta)
        whole = {o: rec.outputs[o] - y for o, y in simulated.items() if np.all(np.isfinite(y))}
    moved = moved_by_input_noise(problem, base)
    floors = {}
    for o in problem.twin.outputs:
        longest = max(problem.fit_spans + problem.held_spans, key=lambda s: s[1] - s[0])
        full = base.residual[o]
        r = full if full.size == rec.n else full[longest[0] : longest[1]]
        floors[o] = noise_floor(
            rec.outputs[o], r, 1 / rec.dt, declared=rec.noise.get(o), inputs=inputs, whole=whole.get(o),
            resolution=rec.declared_step.get(o, 0.0),
        )  # fmt: skip
        again = repeated_noise(rec, o) if rec.noise.get(o) is None else None
        if again is not None:
            floors[o] = replace(floors[o], rms=again, white_rms=min(floors[o].white_rms, again), method="repeats")
        floors[o] = floors[o].with_inputs(moved.get(o, 0.0))
    return problem.with_floors(floors)


def moved_by_input_noise(problem: Problem, base: Fit) -> dict[str, float]:
    """Return the rms by which the error of inputs with declared noise moves each output; none for exact inputs."""
    rec = problem.recording
    if not rec.input_noise:
        return {}
    rng = np.random.default_rng([problem.seed, rec.n])
    shaken = {
        s: x + error_of_mean(x, rec.input_noise[s], rng) if s in rec.input_noise else x for s, x in rec.inputs.items()
    }
    with np.errstate(all="ignore"):
        one, two = (
            base.model.simulate(View.whole(r, problem.init), base.theta) for r in (rec, replace(rec, inputs=shaken))
        )
        found = {o: float(np.std(two[o] - one[o])) for o in one}
    return {o: v for o, v in found.items() if np.isfinite(v)}


@dataclass(frozen=True)
class Posed:
    """Holds a recording ready for a search: ``raw`` is the twin as given, ``base`` that with re-fitted parameters."""

    recording: Recording
    effects: tuple[Effect, ...]
    problem: Problem
    raw: Fit
    base: Fit
    holds: Mapping[str, Hold]
    """Course of each input between its samples; empty for a twin without memory."""


def pose(recording: Recording, held_out: float, seed: int, effects: Iterable[Effect] | None, look: Look) -> Posed:
    """Prepare everything that comes before the search: runs joined, circuits opened, hold of the inputs, noise.

    ``look`` searches a part of a very long recording.
    """
    recording, was_joined = joined(with_equations(recording))
    catalogue = tuple(effects if effects is not None else EFFECTS.values())
    recording = opened(recording, held_out, seed)
    if recording.parts and recording.per_recording:
        problem, _, base = prepared(recording, held_out, seed, False)
        recording = levelled(problem, base)
    hints: tuple[Hint, ...] = ()
    # an effect that is too weak for one recording is also too weak for an excerpt
    long = recording.n > VERY_LONG if recording.parts else is_long(recording, make(recording))
    if long:
        catalogue, hints = nominated(recording, held_out, seed, catalogue, look)
    problem, raw, base = prepared(recording, held_out, seed, was_joined)
    holds = infer_holds(problem, base)
    turned = {s: h.kind for s, h in holds.items() if h.how != "declared" and h.kind != "linear"}
    if turned:
        recording = with_hold(recording, turned)
        problem, raw, base = prepared(recording, held_out, seed, was_joined)
    problem = replace(problem, hints=hints, imitated=imitated(problem, base, catalogue))
    return Posed(recording, catalogue, problem, raw, base, holds)


@dataclass(frozen=True)
class Ended:
    """Holds a search whose fits run through the whole record.

    ``official`` has the held-out part in one free run if the decisions were made on shorter stretches. ``forms`` has
    other forms of the same effects that fit as well. ``left``: mean square of ``fitted`` in noise variances, on the
    fitted samples of the whole run; None where the decisions were made on it.
    """

    base: Fit
    fitted: Fit
    official: Problem | None = None
    forms: tuple[Fit, ...] = ()
    left: float | None = None


def run_through(posed: Posed, base: Fit, fitted: Fit, held_out: float = 0.3) -> Ended:
    """Repeat the fits for the export: the exported twin runs through, and cumulative effects are fitted in one run."""
    problem, twin = posed.problem, posed.problem.twin
    if not twin.restart or problem.settle or problem.recording.parts:
        return Ended(base, fitted)
    through = restarting(twin, False) if problem.split.own else twin
    whole = problem.split if problem.split.own else make_split(posed.recording, held_out, problem.seed, True)
    course = replace(problem, recording=posed.recording, twin=through, split=whole, hints=())
    base, fitted = (over_the_whole(problem, course, f, posed.raw) for f in (base, fitted))
    left = fit_loss(course, residuals(course, Model(through, fitted.model.placed), fitted.theta))
    return Ended(base, fitted, None if problem.split.own else course, left=left)


def opened(recording: Recording, held_out: float = 0.3, seed: int = 0) -> Recording:
    """Return the recording with its twin as two filters if an effect sits between them (``partition``).

    The busiest stretch decides; a twin that cannot be split costs no time.
    """
    if not splittable(recording):
        return recording
    part = excerpt(fitted_part(recording), 2 * SAMPLES)
    split = split_inside(*prepared(part, held_out, seed, False))
    return recording if split is None else replace(recording, twin=split.twin)


def over_the_whole(problem: Problem, official: Problem, fitted: Fit, given: Fit) -> Fit:
    """Fit the parameters once more in the single free run of ``official``, if that improves it there.

    Short stretches show which physics is missing, but do not determine parameters whose influence accumulates over the
    whole run (an offset of the force under an integrator). Parameters that break the short stretches, where the twin as
    ``given`` does not, are not taken.
    """
    through = Model(official.twin, fitted.model.placed)
    start = residuals(official, through, fitted.theta)
    longer = fit(official, through, [fitted.theta], iterations=25)
    rows = official.fit_rows
    before, after = (
        sum(float(np.mean((r[o][rows] / problem.sigma(o)) ** 2)) for o in r) for r in (start, longer.residual)
    )
    if not longer.ok or not after < 0.9 * before:
        return fitted
    residual = residuals(problem, fitted.model, longer.theta)
    if broken(problem, given.residual, longer.theta, residual):
        return fitted
    return replace(fitted, theta=longer.theta, residual=residual)


def prepared(recording: Recording, held_out: float, seed: int, was_joined: bool) -> tuple[Problem, Fit, Fit]:
    """Return the problem with its noise floors, the twin as given, and the recalibrated twin.

    Several recordings are split by what the recalibrated twin leaves of them.
    """
    found = _prepared(recording, held_out, seed, was_joined)
    if not recording.parts:
        return found
    problem, _, base = found
    left = np.zeros((recording.n, len(base.residual)))
    left[problem.index] = np.abs(np.column_stack([*base.residual.values()]))
    return _prepared(recording, held_out, seed, was_joined, left)


def _prepared(
    recording: Recording, held_out: float, seed: int, was_joined: bool, left: np.ndarray | None = None
) -> tuple[Problem, Fit, Fit]:
    twin = make(recording)
    init = recording.split.initialization or 0
    parts = [(p.start, p.stop) for p in recording.parts]
    own = ranges_of(recording) is None and not parts
    drifts = twin.restart
    if own:
        twin, init = free_run(recording, twin)
        drifts = twin.restart
    dynamic = hasattr(twin, "fastest_per_s")
    if parts:
        twin, init, split = split_recordings(recording, twin, held_out, seed, left)
    else:
        split = make_split(recording, held_out, seed, drifts)
    if not own and not parts and dynamic and not drifts and (was_joined or starts_anew(recording, twin, split, init)):
        # the second recording has its own start
        twin = restarting(twin, True)
    if not own and not parts and twin.restart:
        init = max(init, 20) if drifts or not init else init
    if not own and not parts and drifts:
        split = shot(split, init)
    else:
        # a short record must keep samples to score
        init = min(init, min(b - a for a, b in split.held_out) // 3)
    # the first samples show a start state with their noise, and inside a play not at all; of an axis they have to
    afresh = own and drifts and inside_of(twin) is not None
    problem = Problem(recording, twin, split, init, seed, afresh=afresh)
    settle = dynamic and not drifts
    # the engineer's start state is that of a single run
    raw = as_given(replace(problem, settle=settle and (twin.restart or "x0" not in recording.twin.parameters)))
    problem = replace(problem, settle=settle)
    rough = {o: max(float(np.std(r)), 1e-300) for o, r in raw.residual.items()}
    problem = problem.with_floors(
        {o: noise_floor(problem.measured[o], raw.residual[o], 1 / recording.dt, declared=rough[o]) for o in rough}
    )
    problem = set_floors(problem, preferred(problem, fit_base(problem)))
    return problem, raw, preferred(problem, fit_base(problem))


def split_recordings(
    recording: Recording, twin: Twin, held_out: float, seed: int, left: np.ndarray | None = None
) -> tuple[Twin, int, Split]:
    """Return the twin that restarts in every recording of several, and the split that holds whole recordings out.

    The number of samples that set its start is returned as well. ``left`` (n, outputs): the size of the residual of the
    recalibrated twin, of which both parts shall have the same distribution, because an effect may be in a few
    recordings only.
    """
    parts = [(p.start, p.stop) for p in recording.parts]
    init, skip = 0, UNKNOWN_START
    fastest_per_s = getattr(twin, "fastest_per_s", None)
    if fastest_per_s is not None:
        twin, skip = restarting(twin, True), 0.0
        shortest = min(b - a for a, b in parts)
        init = int(np.clip(4.0 / max(fastest_per_s * recording.dt, 1e-9), 20, max(shortest // 4, 20)))
    signals = np.column_stack([*recording.signals.values(), *(() if left is None else left.T)])
    return twin, init, split_of_parts(signals, parts, held_out=held_out, seed=seed, init=init, skip=skip)


def starts_anew(recording: Recording, twin: Twin, split: Split, init: int) -> bool:
    """Return True if the test part of an official split is another run: its first samples may set a state and the twin,
    run on from the fitted part, is far off there at once, by more than it ever is on average.
    """
    if init <= 0:
        return False
    raw = as_given(Problem(recording, twin, split, 0, 0))
    begin = min(a for a, _ in split.held_out) - init
    row = raw.model.twin.outputs
    simulated = raw.model.simulate(View.whole(recording), raw.theta)
    fit = split.fit_mask()
    for o in row:
        r = recording.outputs[o] - simulated[o]
        if float(np.median(np.abs(r[begin : begin + init]))) > ANEW * float(np.sqrt(np.mean(r[fit] ** 2))):
            return True
    return False


ANEW = 3.0
"""Residual at the start of a test part, relative to that of the fitted part, above which the test is a separate run."""


def preferred(problem: Problem, base: Fit) -> Fit:
    """Return the re-fitted base, or the engineer's own values if the re-fit is worse on held-out samples."""
    given = as_given(problem)
    if not given.ok or not stayed(problem, given.residual):
        return base
    return base if base.ok and misfit(problem, base) <= misfit(problem, given) else given


Look = Callable[[Problem, Fit, tuple[Effect, ...]], tuple[set[str], list[Hint]]]
"""Searches a part of a recording; returns the names that may matter, and the fits of the best as hints."""


def nominated(
    recording: Recording, held_out: float, seed: int, catalogue: tuple[Effect, ...], look: Look
) -> tuple[tuple[Effect, ...], tuple[Hint, ...]]:
    """Return the effects that an excerpt at full rate or a thinned copy of a long record accepts, and hints.

    The effects include close rivals; the hints are the fits on the excerpt.
    """
    recording = fitted_part(recording)
    if recording.n < 2 * part_of(recording):
        return catalogue, ()
    names: set[str] = set()
    hints: list[Hint] = []
    parts = [(excerpt(recording, part_of(recording)), catalogue)]
    if "discrete" in getattr(make(recording), "holds", {}).values():
        # a difference equation is valid at its own rate only
        names |= set(OVER_ALL)
    else:
        slow = tuple(e for e in catalogue if e.name in SLOW)
        parts.append((thinned_copy(recording, part_of(recording)), slow))
    for part, allowed in parts:
        problem, _, base = prepared(part, held_out, seed, False)
        found, new_hints = look(problem, base, allowed)
        names |= found
        if part is parts[0][0]:
            hints = new_hints
    return tuple(e for e in catalogue if e.name in names), tuple(hints)


def may_hint(placed: Placed, candidate: Candidate) -> bool:
    """Return True if the fit of an effect on a part is a start for the whole: not for instants or sample lattices."""
    return not candidate.tested and placed.effect.driven


def hint_of(placed: Placed, fitted: Fit) -> Hint:
    """Return the fit of an effect on a part as a hint."""
    model, theta = fitted.model, fitted.theta
    nonlinear, weights = model.slices(model.placed.index(placed))
    return Hint(placed, theta[: model.n_base], (theta[nonlinear], theta[weights]))
