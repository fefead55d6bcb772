"""The estimators' part of the tremor report: every method beside the limit, per set and person."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from firmware_py.tremor.config import Method
from tools.errors import InputError
from tools.research.tremor.adapting import AT_S, LEADS_S, WINDOW_S, adapting
from tools.research.tremor.cases import Case, case_of, emulated_hand
from tools.research.tremor.evaluate import ORACLE, OTHERS, UNSEEN, evaluate, summarise
from tools.research.tremor.report import table
from tools.research.tremor.signal import TremorSignal

METHODS: tuple[Method, ...] = ("adaptive", "kalman", "wflc_flc", "bmflc_kalman")
HORIZONS_MS = (0, 2, 8, 20)
LOOP_MS = 2
GOAL = 1.15
EMULATED = (101, 102, 103)
PART_S = (20.0, 50.0)


def chosen(signals: Sequence[TremorSignal]) -> list[Case]:
    """Hands, not shaken tables: 30 s of each gyroscope, or of the accelerometer where there is no other."""
    cases: list[Case] = []
    for seed, signal in enumerate(signals):
        if signal.reference.drive_hz is not None or "table" in signal.name or "2hz" in signal.name:
            continue
        if signal.quantity != "angular rate" and signal.data_set != "tremor_duke_adxl345":
            continue
        part = signal.part(*PART_S) if signal.seconds > PART_S[1] else signal
        try:
            cases.append(case_of(part, seed))
        except InputError:  # nothing moves in it
            continue
    return cases


def section(signals: list[TremorSignal], progress: Callable[[str], None]) -> list[str]:
    """Markdown lines."""
    cases = [*chosen(signals), *(emulated_hand(seed) for seed in EMULATED)]
    results = evaluate(cases, METHODS, HORIZONS_MS, progress=progress)
    lines = summarise(results)
    out = [
        "## Estimators beside the limit",
        "",
        "Each hand is scaled to the instrument's 50 um peak to peak, the instrument's sensor noise is added, and what",
        "each method leaves of the motion between 2 and 20 Hz is counted from 5 s on, in percent of its rms. The",
        "adaptive method has its defaults here, which cancel 2 to 20 Hz; the preset of the benches cancels less, keeps",
        "still above and is scored by `micron hands`. Lifted: an error in 8 to 12 Hz counts four times, as the",
        "defaults weigh it; the limits are the best causal linear filters (fixed) in that measure. Others: trained on",
        "other people's records (of the same set, or, if",
        "that holds one person, of the other sets). Oracle: on the very record. Itself unseen: on the record but for",
        "the second that is scored, in turn. Where that leaves much more than the oracle, the oracle knows its own",
        "second by heart: 24 weights an axis, fitted to one swing of 3 s that outweighs the whole record (wrist, mouse",
        "03 and 05).",
        "No estimator can know a second before it comes, so there the ratio to the oracle is no measure of learning.",
        "Emulated hands: three seeds that nothing was tuned on. Settings of the adaptive method were chosen on other",
        "parts of the recordings (80 to 230 s) and on other emulated hands, with the figures of this page in view; its",
        "prior for bursts is the mean spectrum of the seven recorded people in those other parts.",
        "",
    ]
    for h in HORIZONS_MS:
        rows = [
            [
                f"{s.group}, {s.method}",
                str(s.cases),
                f"{s.all_percent:.1f}",
                f"{s.band_percent:.1f}",
                f"{s.lifted_percent:.1f}",
                f"{s.to_others:.2f}",
                f"{s.to_oracle:.2f}",
                f"{s.to_unseen:.2f}",
                f"{s.delay_ms:.1f}",
            ]
            for s in lines
            if s.horizon_ms == h
        ]
        head = [
            "set, method",
            "records",
            "2-20 Hz",
            "8-12 Hz",
            "lifted",
            "/ others",
            "/ oracle",
            "/ unseen",
            "late (ms)",
        ]
        out += [f"{h} ms ahead:", "", *table(head, rows), ""]
    people = [r for r in results if r.horizon_ms == LOOP_MS]
    names = (*METHODS, OTHERS, ORACLE, UNSEEN)
    rows = []
    for case in dict.fromkeys(r.case for r in people):
        by_method = {r.method: r.score.lifted_percent for r in people if r.case == case}
        ratios = [by_method[METHODS[0]] / by_method[limit] for limit in (ORACLE, UNSEEN)]
        cells = [f"{by_method[m]:.1f}" if m in by_method else "-" for m in names]
        rows.append([case, *cells, *(f"{ratio:.2f}" for ratio in ratios)])
    near, beside = (sum(float(row[n]) <= GOAL for row in rows) for n in (-2, -1))
    out += [
        f"Per record, {LOOP_MS} ms ahead, lifted (%); the last columns are adaptive / oracle, goal {GOAL:g}: "
        f"{near} of {len(rows)} records, and adaptive / itself unseen: {beside} of {len(rows)}.",
        "",
        *table(["record", *names, "/ oracle", "/ unseen"], rows),
        "",
    ]
    progress("adaptation")
    known = adapting(cases, LOOP_MS)
    mean = [float(np.mean([row[n] for row in known.values()])) for n in range(len(LEADS_S))]
    worst = [max(row[n] for row in known.values()) for n in range(len(LEADS_S))]
    return [
        *out,
        "### A new hand",
        "",
        f"The stretch from {AT_S:g} s to {AT_S + WINDOW_S:g} s of each of {len(known)} records, met by an estimator",
        f"that was started some time before it: what it leaves, lifted, {LOOP_MS} ms ahead, over what an estimator",
        f"leaves that has known the hand for {LEADS_S[-1]:g} s.",
        "",
        *table(
            ["records", *(f"{lead:g} s" for lead in LEADS_S)],
            [["mean", *(f"{x:.2f}" for x in mean)], ["worst", *(f"{x:.2f}" for x in worst)]],
        ),
    ]
