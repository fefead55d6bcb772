"""Runs all faults at all operating points with all seeds; returns a row per fault and point."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass
from itertools import chain
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from hal.bench import load_bench
from hal.children import begin_as_worker
from tools.interrupt import keep_what_is_there, need_some
from tools.output import write_text_atomic
from tools.research.faults.fault import Fault
from tools.research.faults.judge import ENDED_WELL, Observation
from tools.research.faults.pairs import draw_pairs
from tools.research.faults.phases import LEARNING, PHASES, START, STEADY, Phase, accepted_answers
from tools.research.faults.points import POINTS, write_bench
from tools.research.faults.trial import observe_running, observe_start

NUMBERS = re.compile(r"-?\d+\.\d+")
DECIDED = ("safe state", "holds", "resumes")
TOLD = (*DECIDED, "refused")
WITHIN_MS = 20.0  # from the moment at which the tip has gone 5 um astray


@dataclass(frozen=True)
class FaultRow:
    """Holds the results of a fault at an operating point, in all phases, over all seeds."""

    fault: Fault
    point: str
    observations: tuple[Observation, ...]

    @property
    def seeds(self) -> int:
        return len(self.observations)

    @property
    def detected(self) -> int:
        """Runs in which the instrument tripped, held, noticed, or refused to start."""
        return sum(o.answer != "none" for o in self.observations)

    @property
    def answer(self) -> str:
        """The commonest answer where the outputs work when the fault strikes, or before the devices are opened."""
        usual = [o for o in self.observations if o.happened and o.phase in (LEARNING.name, STEADY.name, START.name)]
        answers = [o.answer for o in usual or self.observations]
        return max(sorted(set(answers)), key=answers.count)

    @property
    def as_expected(self) -> int:
        return sum(self.is_as_expected(o) for o in self.observations)

    def is_as_expected(self, o: Observation) -> bool:
        """``o`` has an accepted answer; the one to a fault that has not struck after all is none."""
        if not o.happened:
            return o.answer == "none" or o.held_on
        return o.answer in accepted_answers(self.fault, o.phase)

    @property
    def late(self) -> int:
        """Runs in which the tip went more than 5 um astray and nothing was known of it 20 ms later."""
        return sum(moved_unseen(o) for o in self.observations)

    @property
    def unsafe(self) -> int:
        """Unsafe demands that were the firmware's, and reports of a neutral that was none. What the fault itself does
        to the output is counted apart, but no fault excuses such a report."""
        rough = 0 if self.fault.own_output else sum(o.rough for o in self.observations)
        return rough + sum(o.false_neutral for o in self.observations)

    @property
    def wrong_messages(self) -> int:
        """Count the trips, holds and refusals whose message contains none of the words of the fault."""
        return sum(self.is_misnamed(o) for o in self.observations)

    def is_misnamed(self, o: Observation) -> bool:
        """The message of ``o`` names none of the words that belong to the fault."""
        # a self-test that still waits when its run is ended has not said anything yet
        is_reported = o.answer in TOLD and not o.held_on and not o.message.startswith(ENDED_WELL)
        return is_reported and not any(word.lower() in o.message.lower() for word in self.fault.names)

    @property
    def is_good(self) -> bool:
        """Every answer is as expected; nothing is unsafe, uncounted or wrongly named."""
        bad = self.unsafe + self.wrong_messages + sum(o.uncounted for o in self.observations)
        return not bad and self.as_expected == self.seeds

    @property
    def known_by(self) -> str:
        """Return what said so first, in the words most often used (numbers left out); empty: nothing."""
        messages = [NUMBERS.sub("#", o.known_by) for o in self.observations if o.known_by]
        return max(sorted(set(messages)), key=messages.count) if messages else ""

    @property
    def isolated(self) -> int:
        """Runs in which what was said names the part that is broken."""
        parts = (self.fault.part,) if self.fault.part else self.fault.names
        messages = [f"{o.known_by} {o.message}".lower() for o in self.observations if o.known_by]
        return sum(any(part.lower() in text for part in parts) for text in messages)

    def as_dict(self) -> dict[str, Any]:
        """Row of the contract's JSON, and what else is known. Times and distances are those of outputs that work."""
        return {
            "fault": self.fault.name,
            "point": self.point,
            "seeds": self.seeds,
            "detected": self.detected,
            "detect_ms": _spread([o.detect_ms for o in self.observations]),
            "answer": self.answer,
            "answer_ms": _spread([o.neutral_ms for o in self.observations if o.answer in DECIDED]),
            "unsafe_outputs": self.unsafe,
            "uncounted_samples": sum(o.uncounted for o in self.observations),
            "tip_error_um_max": max(o.astray_um for o in self.observations),
            "message_names_cause": self.wrong_messages == 0,
            "expected": self.fault.expected,
            "as_expected": self.as_expected,
            "moved_unseen": self.late,
            "not_confirmed": sum(not o.confirmed for o in self.observations),
            "message": next((o.message for o in self.observations if o.answer in TOLD), ""),
            "why": self.fault.why,
            "known_by": self.known_by,
            "isolated": self.isolated,
            "samples_lost_max": max(o.lost for o in self.observations),
        }


def moved_unseen(o: Observation) -> bool:
    """The tip was 5 um astray and 20 ms later nothing was known of it."""
    if o.moved_ms is None:
        return False
    return o.detect_ms is None or o.detect_ms > o.moved_ms + WITHIN_MS


def totals(rows: Sequence[FaultRow]) -> dict[str, Any]:
    """Sums over the campaign; the goals are those of the reliability page."""
    runs = [o for row in rows for o in row.observations]
    moving = [o for row in rows if not row.fault.is_pair for o in row.observations if o.moved_ms is not None]
    ours = [
        o for row in rows if not row.fault.is_pair and row.fault.is_told_in_time
        for o in row.observations if o.moved_ms is not None
    ]  # fmt: skip
    return {
        "faults": len({row.fault.name for row in rows if not row.fault.is_pair}),
        "pairs": len({row.fault.name for row in rows if row.fault.is_pair}),
        "points": len({row.point for row in rows}),
        "runs": len(runs),
        "did_not_strike": sum(not o.happened for o in runs),
        "as_expected": sum(row.as_expected for row in rows),
        "moving_the_tip_5_um": len(moving),
        "of_these_known_within_20_ms": sum(not moved_unseen(o) for o in moving),
        "ours_moving_the_tip_5_um": len(ours),
        "ours_known_within_20_ms": sum(not moved_unseen(o) for o in ours),
        "unsafe_outputs": sum(row.unsafe for row in rows),
        "jumps_of_the_fault": sum(o.rough for row in rows if row.fault.own_output for o in row.observations),
        "uncounted_samples": sum(o.uncounted for o in runs),
        "wrong_messages": sum(row.wrong_messages for row in rows),
    }


def run_campaign(
    bench: Path,
    faults: Sequence[Fault],
    *,
    seeds: Sequence[int],
    n_pairs: int = 0,
    jobs: int,
    progress: Callable[[str], None],
    keep: Path | None = None,
    revision: str = "",
    compiled: bool = False,
) -> list[FaultRow]:
    """Every fault at every point in every phase with every seed, in virtual time, in ``jobs`` processes; after them
    the rows of ``n_pairs`` pairs of faults, which are drawn from the first seed. Deterministic.

    After Ctrl-C the rows hold what is there; KeyboardInterrupt if that is nothing. ``keep``: a folder in which what is
    done is kept; a campaign that was stopped goes on from there. Kept results of
    another ``revision``, bench or choice of faults are not used. ``compiled``: the ticks run in the compiled thread.
    """
    if has_redundancy(bench):
        faults = [fault.with_redundancy() for fault in faults]
    if reads_back(bench):
        faults = [fault.with_read_back() for fault in faults]
    folder = Path(tempfile.mkdtemp(prefix="micron-faults-"))
    try:
        benches = {point.name: write_bench(bench, point, folder) for point in POINTS}
        what = repr((revision, bench.read_text(encoding="utf-8"), faults, compiled))
        key = hashlib.sha256(what.encode()).hexdigest()[:16]
        kept = _Kept(keep, key)
        at_start = tuple(fault for fault in faults if fault.at_start)
        running = tuple(fault for fault in faults if not fault.at_start)
        planned = [
            Trial(benches[point.name], point.name, phase, group, seed, compiled=compiled)
            for point in POINTS
            for seed in seeds
            for phase, group in [(None, at_start), *((phase, running) for phase in PHASES)]
            if group
        ]
        pairs = draw_pairs(running, n_pairs, seeds[0])
        for k, group in enumerate(pairs):
            point = POINTS[k % len(POINTS)]
            phase = PHASES[k // len(POINTS) % len(PHASES)]
            planned.append(Trial(benches[point.name], point.name, phase, group, seeds[0] + k, True, compiled))
        trials = [trial for trial in planned if kept.read(trial) is None]
        done = [observations for trial in planned if (observations := kept.read(trial)) is not None]
        found: dict[tuple[str, str], list[Observation]] = {}
        with keep_what_is_there():
            answers = (kept.write(trial, answer) for trial, answer in _in_parallel(trials, jobs))
            for observations in chain(done, answers):
                first = observations[0]
                progress(f"{first.point} hand, {first.phase}, seed {first.seed}")
                for o in observations:
                    found.setdefault((o.fault, o.point), []).append(o)
        need_some(found)
        return [
            FaultRow(fault, point.name, tuple(sorted(rows, key=lambda o: (o.seed, o.phase))))
            for fault in (*faults, *chain(*pairs))
            for point in POINTS
            if (rows := found.get((fault.name, point.name)))
        ]
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@dataclass(frozen=True)
class Trial:
    """Names a hand, a seed, a phase (``None``: before the devices are opened) and the faults that strike there."""

    bench: Path
    point: str
    phase: Phase | None
    faults: tuple[Fault, ...]
    seed: int
    pairs: bool = False
    compiled: bool = False

    @property
    def name(self) -> str:
        """The trial among all of a campaign."""
        phase = self.phase.name if self.phase else "start"
        return f"{self.point}-{phase}-{self.seed}" + ("-pairs" if self.pairs else "")

    def observe(self) -> list[Observation]:
        if self.phase is None:
            return [
                observe_start(self.bench, self.point, fault, self.seed, compiled=self.compiled) for fault in self.faults
            ]
        return observe_running(self.bench, self.point, self.faults, self.seed, self.phase, compiled=self.compiled)


@dataclass(frozen=True)
class _Kept:
    folder: Path | None
    key: str

    def _path(self, trial: Trial) -> Path | None:
        return None if self.folder is None else self.folder / f"{self.key}-{trial.name}.json"

    def read(self, trial: Trial) -> list[Observation] | None:
        path = self._path(trial)
        if path is None or not path.is_file():
            return None
        return [Observation(**table) for table in json.loads(path.read_text(encoding="utf-8"))]

    def write(self, trial: Trial, observations: list[Observation]) -> list[Observation]:
        path = self._path(trial)
        if path is not None:
            write_text_atomic(path, json.dumps([asdict(o) for o in observations]))
        return observations


def has_redundancy(bench: Path) -> bool:
    """Return whether the instrument of ``bench`` has more than six accelerometer axes."""
    devices = load_bench(bench).description.devices_with("adxl203").values()
    return sum(len(device.options().get("channels", ())) for device in devices) > 6


def reads_back(bench: Path) -> bool:
    """Return whether the amplifier of ``bench`` reads every command back."""
    amplifiers = load_bench(bench).description.devices_with("dac_amplifier").values()
    return any(amplifier.options().get("read_back") for amplifier in amplifiers)


def _observe(trial: Trial) -> tuple[Trial, list[Observation]]:
    return trial, trial.observe()


def _in_parallel(trials: Sequence[Trial], jobs: int) -> Iterator[tuple[Trial, list[Observation]]]:
    if jobs <= 1:
        yield from map(_observe, trials)
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn"), initializer=begin_as_worker) as pool:
        waiting: set[Future[tuple[Trial, list[Observation]]]] = {pool.submit(_observe, trial) for trial in trials}
        while waiting:
            done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
            for future in done:
                yield future.result()


def _spread(times_ms: Sequence[float | None]) -> dict[str, float | None]:
    known = [t for t in times_ms if t is not None]
    return {"p50": float(np.median(known)), "max": max(known)} if known else {"p50": None, "max": None}
