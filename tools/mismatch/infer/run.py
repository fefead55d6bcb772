"""Diagnoses a recording: prepares it, searches, decides by the score, and assembles the report."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.stats import norm
from threadpoolctl import threadpool_limits

from sim_devices.physics.effect import Effect
from tools.mismatch.engine.assemble import conclude
from tools.mismatch.engine.evidence import Doubt
from tools.mismatch.engine.hold import with_hold
from tools.mismatch.engine.identifiability import LeastNamed, experiment
from tools.mismatch.engine.pose import Ended, Posed, pose, run_through
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.report import Alternative, Equivalent, Hold, Report, Sealed, Verdict
from tools.mismatch.engine.score import held_rms
from tools.mismatch.engine.verdict import Decision, fit_trouble, meaning_of, within_tolerance
from tools.mismatch.infer.borne_out import doubts_of
from tools.mismatch.infer.constants import Constants, constants_for, vouched
from tools.mismatch.infer.decide import (
    LIKELY,
    Answer,
    decide,
    forms_as_good,
    log_odds,
    other_forms,
    recalibrated,
    without_doubted,
)
from tools.mismatch.infer.holds import better_holds
from tools.mismatch.infer.pooled import pool
from tools.mismatch.infer.sealed import score_sealed, seal
from tools.mismatch.infer.search import Found, look, nominees, search
from tools.mismatch.infer.store import Scored, Store
from tools.mismatch.recording import Recording
from tools.mismatch.report.wording import rival_remark

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Inferred:
    """Holds a prepared recording and the result of the search: everything that a decision needs.

    ``whole`` is the recording with the sealed end, which neither has used; ``unsealed`` is the reason for none.
    """

    posed: Posed
    found: Found
    whole: Recording
    unsealed: str


def infer(
    recording: Recording, constants: Constants, *, held_out: float = 0.3, seed: int = 0, jobs: int = 1,
    progress: Progress | None = None, effects: Iterable[Effect] | None = None,
) -> Inferred:  # fmt: skip
    """Prepare the recording and search, without a decision. The linear algebra uses one thread."""
    kept, unsealed = seal(recording)
    # trials may diverge
    with threadpool_limits(1), np.errstate(all="ignore"):
        posed = pose(kept, held_out, seed, effects, partial(look, constants, jobs, progress))
        found = search(posed.problem, posed.base, posed.effects, constants, jobs=jobs, progress=progress)
        if kept.parts:
            found, posed = pool(found, posed, jobs)
    return Inferred(posed, found, recording, unsealed)


def diagnose(
    recording: Recording, *, held_out: float = 0.3, seed: int = 0, jobs: int = 2, progress: Progress | None = None,
    effects: Iterable[Effect] | None = None, constants: Constants | None = None,
) -> Report:  # fmt: skip
    """Locate the mismatch, name the physics and state its probability.

    ``constants`` default to those for the kind of twin.
    """
    began = time.perf_counter()
    find = partial(
        infer, constants=constants or constants_for(recording.twin.kind), held_out=held_out, seed=seed, jobs=jobs,
        progress=progress, effects=effects,
    )  # fmt: skip
    inferred = find(recording)
    with threadpool_limits(1), np.errstate(all="ignore"):
        answer = decide(inferred.found.store, inferred.found.first)
        if held := better_holds(inferred.found.store, answer.chosen, inferred.posed.holds):
            inferred = searched_again(inferred, held, find)
            answer = decide(inferred.found.store, inferred.found.first)
        report = report_of(inferred, answer, held_out, jobs)
    known = vouched(recording.twin.kind) if constants is None and report.physics else None
    return replace(report, vouched=known, seconds=time.perf_counter() - began)


def searched_again(before: Inferred, held: Mapping[str, Hold], find: Callable[..., Inferred]) -> Inferred:
    """Return a search with these inputs held, of the names that mattered ``before``.

    Half a sample decides between them; it raises none that were far behind.
    """
    effects, posed = nominees(before.found.store, before.posed.effects), before.posed
    after = find(with_hold(before.whole, dict.fromkeys(held, "zero")), effects=effects)
    posed = replace(after.posed, effects=posed.effects, holds={**after.posed.holds, **held})
    return replace(after, posed=posed, found=replace(after.found, first=before.found.first))


def report_of(inferred: Inferred, answer: Answer, held_out: float, jobs: int) -> Report:
    """Return the report of an answer."""
    store = inferred.found.store
    posed = replace(inferred.posed, problem=store.problem)  # with the noise floors that the search found
    answer, decision, chosen, ended = _through(posed, store, answer, held_out)
    report = conclude(
        posed, ended, inferred.found.first, dict(answer.left), decision=decision, sure=answer.sure,
        least=least_named(store), withheld=answer.withheld, jobs=jobs,
    )  # fmt: skip
    sealed = Sealed(None, inferred.unsealed)
    if not inferred.unsealed:
        sealed = score_sealed(inferred.whole, posed, ended.base, ended.fitted)
    return replace(
        report,
        fit=replace(report.fit, sealed=sealed),
        # the most likely first; of equals the one that explains more
        physics=tuple(sorted(report.physics, key=lambda p: -effect_size(store, chosen, p.name))),
        alternatives=alternatives_of(store, answer) if chosen.placed else (),
        equivalent=equivalents_of(store, answer) if chosen.placed else (),
    )


def _through(posed: Posed, store: Store, answer: Answer, held_out: float) -> tuple[Answer, Decision, Scored, Ended]:
    """Return the answer with its verdict, the reported set, and the fits that run through the whole record.

    The decision is made on short stretches where the twin accumulates. An effect that the run through the whole record
    does not bear out is dropped.
    """
    while True:
        decision = verdict_of(posed, store, answer)
        named = decision.verdict in ("missing_physics", "unexplained")
        chosen = answer.chosen if named else store.base
        chosen, ended = best_form(posed, store, chosen, held_out)
        answer = replace(answer, chosen=chosen) if named else answer
        apart = ended.fitted is not chosen.fitted
        doubts = doubts_of(posed.problem, ended.fitted) if apart else []
        if apart and not doubts and is_no_better(posed.problem, ended):
            doubts = [Doubt(k, "no_better", ()) for k in range(len(chosen.placed))]
        if not doubts:
            return answer, decision, chosen, replace(ended, forms=forms_as_good(store, chosen) if named else ())
        # one at a time: without the weakest of two that stand for each other, the other may be certain
        weakest = min(doubts, key=lambda d: effect_size(store, chosen, chosen.placed[d.k].effect.name))
        answer = without_doubted(store, answer, ended.fitted, weakest)


def is_no_better(problem: Problem, ended: Ended) -> bool:
    """Return True if the run that is reported leaves no less of what is held out with the effects than without.

    Events, and courses that no run predicts, are judged by other means.
    """
    placed = [p.effect for p in ended.fitted.model.placed]
    if not placed or any(e.claims is not None or e.stochastic or e.predict is not None for e in placed):
        return False
    without, within = (held_rms(ended.official or problem, f) for f in (ended.base, ended.fitted))
    return sum(math.log(max(within[o], 1e-300) / max(rms, 1e-300)) for o, rms in without.items()) >= 0.0


def best_form(posed: Posed, store: Store, chosen: Scored, held_out: float) -> tuple[Scored, Ended]:
    """Return the form of the effects of ``chosen`` that leaves least in the run through the whole record, and that run.

    Short stretches tell which effects are missing; of a twin that accumulates, they hardly tell forms of one apart.
    """
    ended = run_through(posed, store.base.fitted, chosen.fitted, held_out)
    if ended.left is None or not chosen.placed:
        return chosen, ended
    for other in other_forms(store, chosen):
        one = run_through(posed, store.base.fitted, other.fitted, held_out)
        # the comparison with None is for the type checker: every form of one twin runs through, or none does
        if (one.left or 0.0) < (ended.left or 0.0) and not doubts_of(posed.problem, one.fitted):
            chosen, ended = other, one
    return chosen, ended


def least_named(store: Store) -> LeastNamed:
    """Return the thresholds of naming for the limits of detection.

    They are the test of the effect, and the noise variances that pay its price and the odds at which it is likely.
    """
    c = store.constants
    least = math.expm1(2.0 * (c.per_name + c.per_parameter + log_odds(LIKELY)) / store.count.noise)
    return LeastNamed(c.least_z, least / (1.0 + least))


def effect_size(store: Store, chosen: Scored, name: str) -> float:
    """Return the nats that a name adds to a set."""
    small = store.without(chosen, lambda p: p.effect.name == name)
    return sum(chosen.density.values()) - sum(small.density.values())


def alternatives_of(store: Store, answer: Answer) -> tuple[Alternative, ...]:
    rms = {id(r): held_rms(store.problem, r.scored.fitted)[r.output] for r in answer.rivals}
    return tuple(
        Alternative(r.name, r.output, rms[id(r)], rival_remark(r.ratio, r.as_good, r.instead_of)) for r in answer.rivals
    )


def equivalents_of(store: Store, answer: Answer) -> tuple[Equivalent, ...]:
    """Return the names that this recording cannot distinguish from a named one, with the recording that would."""
    effects = {p.effect.name: p.effect for s in store.sets.values() for p in s.placed}
    out: list[Equivalent] = []
    for name in sorted(answer.chosen.names):
        alike = [r.name for r in answer.rivals if r.instead_of == name and r.as_good]
        if alike:
            out.append(Equivalent((name, *alike), experiment(effects[name], effects[alike[0]])))
    return tuple(out)


def verdict_of(posed: Posed, store: Store, answer: Answer) -> Decision:
    """Return the verdict. Differences within a declared tolerance do not count."""
    problem, raw, base, fitted = store.problem, posed.raw, store.base.fitted, answer.chosen.fitted
    floors = dict(answer.floors)
    if all(within_tolerance(problem, raw).values()):
        return Decision("agrees", 1.0, "", (), floors)
    if not answer.whole:
        trouble = fit_trouble(problem, raw, base, fitted)
        p = answer.strange.p_value if answer.strange is not None else least_p(answer.left.values())
        meaning = "floor_doubtful" if answer.doubtful else meaning_of(problem, dict(answer.left), trouble)
        return Decision("unexplained", p, meaning, trouble, floors, answer.doubtful)
    if answer.chosen.placed:
        # corrected for the number of screened candidates (Bonferroni)
        p = min(1.0, float(norm.sf(store.least_z(answer.chosen))) * max(len(store.seen), 1))
        return Decision("missing_physics", p, "", (), floors, answer.doubtful)
    nothing_missing: Verdict = "recalibrate" if recalibrated(store, raw) else "agrees"
    return Decision(nothing_missing, 1.0, "", (), floors, answer.doubtful)


def least_p(left: Iterable[object]) -> float:
    return min((d.p_value for v in left for d in getattr(v, "follows", ())), default=1.0)


__all__: Sequence[str] = ["Inferred", "diagnose", "infer", "report_of"]
