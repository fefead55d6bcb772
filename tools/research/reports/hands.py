"""The instrument in real hands: closed loop on recorded tremor, for three estimators, beside the limits, as a table.

Recorded hands give the tremor; voluntary path and drift stay synthetic, all sensor and actuator errors are on. Runs are
those without wires (``tools.closed_loop``), which leave the same tremor as runs over the wire.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from math import isfinite
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np

from hal.bench import BenchFile
from sim_devices.config import emulation_config
from sim_devices.plant.hand_file import load_hand
from sim_devices.plant.recorded_hand import make_hand
from tools.closed_loop.simulate import simulate
from tools.reports.figures import BANDS_HZ, SHOWN_HZ, TREMOR_BAND_HZ, TremorFigures, density_text, tremor_figures
from tools.research.reports.hand_limits import (
    ABOVE_HZ,
    BandParts,
    FineMotion,
    Swing,
    band_parts,
    causal_um,
    fine_motion,
    known_tremor_um,
    strongest,
)

METHODS = ("adaptive", "kalman", "wflc_flc")
SETTLE_S = 5.0
GOAL_PERCENT = 70.0
GOAL_ABOVE_UM = 2.0
"""Motion that may be added above 20 Hz on recorded hands."""
GOAL_ABOVE_SYNTHETIC_UM = 1.0
HANDS = (
    ("physiological tremor of a stretched arm", "tremor_duke_adxl345/data.npz#arm_extended_no_tremor"),
    ("wrist, imitated tremor", "tremor_duke_adxl345/data.npz#on_wrist_simulated_tremor1"),
    ("shaker at 10.4 Hz", "tremor_duke_adxl345/data.npz#10.4low"),
    ("hand on a mouse, essential tremor (23)", "tremor_mouse_lsm9ds1/imu_23.npz#20:80"),
    ("hand on a mouse, participant 5", "tremor_mouse_lsm9ds1/imu_05.npz#20:80"),
    # 7 of its 15 windows of 4 s with tremor; settings were chosen on 80 to 230 s (``hands_development.toml``)
    ("wrist gyroscope, Parkinson's disease", "tremor_paradigma_pd/data.npz#305:365"),
)
UNSEEN = ("data.npz#305:365",)
"""Sources, as a row names them, of which other parts were chosen on, but not this one."""


@dataclass(frozen=True)
class HandRow:
    """Holds the result of a hand with an estimator."""

    hand: str
    source: str
    method: str
    figures: TremorFigures
    limited_percent: float
    stroke_limit_um: float
    """Left in 8 to 12 Hz if the tremor were known: what the strokes take."""
    causal_limit_um: float
    """Left there by the best causal linear filter fitted to this hand, without any stroke's end."""
    swing: Swing
    recorded_s: float = float("inf")
    """Length of the recording: a run that is longer plays it again. ``inf``: a hand that is not recorded."""
    above: BandParts | None = None
    core: BandParts | None = None
    """Parts of the motion above the tremor band, and of the tremor."""
    fine: FineMotion | None = None
    """Motion above the tremor band in every step of the plant."""

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        return {
            "hand": self.hand,
            "source": self.source,
            "method": self.method,
            "recorded_s": self.recorded_s if isfinite(self.recorded_s) else None,
            "limited_percent": self.limited_percent,
            "stroke_limit_um": self.stroke_limit_um,
            "causal_limit_um": self.causal_limit_um,
            "swing": asdict(self.swing),
            "above_band": None if self.above is None else asdict(self.above),
            "tremor_band": None if self.core is None else asdict(self.core),
            "above_20_Hz_at_8_kHz": None if self.fine is None else asdict(self.fine),
            **self.figures.to_json(),
        }


def run_hands(bench: BenchFile, data: Path, seconds: float, progress: Callable[[str], None]) -> Iterator[HandRow]:
    """Every hand that is there, with every estimator."""
    cases: list[tuple[str, str | None]] = [("synthetic hand, seed 1", None)]
    cases += [(name, str(data / source)) for name, source in HANDS if (data / source.split("#")[0]).exists()]
    for name, source in cases:
        limits: tuple[float, float] | None = None
        recorded_s = load_hand(source).seconds if source else float("inf")
        for method in METHODS:
            row = run_hand(bench, name, source, seconds, progress, method=method, limits=limits, recorded_s=recorded_s)
            if row is None:
                continue
            limits = row.stroke_limit_um, row.causal_limit_um
            yield row


def run_hand(
    bench: BenchFile,
    name: str,
    source: str | None,
    seconds: float,
    progress: Callable[[str], None],
    *,
    method: str | None = None,
    limits: tuple[float, float] | None = None,
    recorded_s: float = float("inf"),
) -> HandRow | None:
    """Run a hand with an estimator (default: the bench's own); None for a run too short to be scored.

    ``limits``: those of this hand, where they are known from another estimator's run.
    """
    progress(f"{name}, {method}" if method else name)
    run = simulate(bench, seconds, hand_file=source, method=method, keep_frames=True, keep_fine=True)
    from_ns = run.armed_ns + round(SETTLE_S * 1e9)
    figures = tremor_figures(run.truth, from_ns=from_ns, to_ns=run.safe_ns)
    if figures is None:
        return None
    emulation = emulation_config(bench.description.model_dump())
    body = np.asarray(make_hand(emulation.hand, emulation.seed, source).frame)
    t_ns = np.asarray(run.truth["t_ns"])
    keep = (t_ns >= from_ns) & (t_ns < run.safe_ns - 500_000_000)  # zero-phase bands are not trusted at the end
    if limits is None:
        progress(f"{name}, limits")
        limits = known_tremor_um(run.truth, keep, body, run.configs.actuation), causal_um(run.truth, keep)
    assert run.frames is not None
    parts = band_parts(run.truth, run.frames, keep, body, run.configs.actuation)
    limited = 100.0 * run.clipped / (1000.0 * seconds)
    where = Path(source).name if source else "-"
    swing = strongest(run.truth, from_ns, run.safe_ns)
    used = run.configs.tremor.method
    return HandRow(
        name,
        where,
        used,
        figures,
        limited,
        *limits,
        swing,
        recorded_s,
        parts[ABOVE_HZ],
        parts[TREMOR_BAND_HZ],
        fine_motion(run, from_ns, run.safe_ns),
    )


def draw_people(revision: str, count: int) -> list[int]:
    """Return the seeds of ``count`` synthetic people, drawn from the source's revision: nobody could choose them."""
    return sorted(random.Random(revision).sample(range(1000, 1_000_000), count))


def run_people(
    bench: BenchFile, seeds: Sequence[int], seconds: float, progress: Callable[[str], None]
) -> Iterator[tuple[TremorFigures, FineMotion]]:
    """Run every synthetic person with the bench's own estimator."""
    for seed in seeds:
        progress(f"synthetic person {seed}")
        run = simulate(bench, seconds, seed=seed, keep_fine=True)
        from_ns = run.armed_ns + round(SETTLE_S * 1e9)
        figures = tremor_figures(run.truth, from_ns=from_ns, to_ns=run.safe_ns)
        if figures is not None:
            yield figures, fine_motion(run, from_ns, run.safe_ns)


def people_table(people: Sequence[tuple[TremorFigures, FineMotion]], seeds: Sequence[int]) -> list[str]:
    """Return the section of the page that sums up the synthetic people."""
    lines = [
        "## Synthetic people drawn from the revision",
        "",
        *wrap(f"Seeds {', '.join(map(str, seeds))}; the bench's own estimator, um rms against the intended path.", 110),
        "",
        "| band | without, mean | with, mean | with, worst | less, mean (%) | less, worst (%) |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for low_hz, high_hz in BANDS_HZ:
        bands = [figures.bands[low_hz, high_hz] for figures, _ in people]
        before, after = ([getattr(b, f"{kind}compensated_rms_um") for b in bands] for kind in ("un", ""))
        less = [b.reduction_percent for b in bands]
        share = ("-", "-") if low_hz == BANDS_HZ[3][0] else (f"{np.mean(less):.1f}", f"{min(less):.1f}")
        cells = (f"{np.mean(before):.2f}", f"{np.mean(after):.2f}", f"{max(after):.2f}", *share)
        name = f"below {high_hz:g} Hz" if low_hz == 0.0 else f"{low_hz:g}-{high_hz:g} Hz"
        lines.append(f"| {name} | {' | '.join(cells)} |")
    added = [fine.added_um for _, fine in people]
    goals = (
        "Goals: 8-12 Hz 85 % less, 2-500 Hz 75 % less (means). Above 20 Hz, seen in every step of the plant (8 kHz), "
        f"at most {GOAL_ABOVE_SYNTHETIC_UM:g} um added (root of the powers' difference): {np.mean(added):.2f} um in "
        f"the mean, {max(added):.2f} um at worst, met in {sum(um <= GOAL_ABOVE_SYNTHETIC_UM for um in added)} of "
        f"{len(added)}."
    )
    return [*lines, "", *wrap(goals, 110), ""]


def markdown(
    rows: list[HandRow],
    seconds: float,
    revision: str,
    people: Sequence[tuple[TremorFigures, FineMotion]] = (),
    seeds: Sequence[int] = (),
) -> str:
    """The page ``docs/results/hands.json``."""
    people_option = f" --people {len(seeds)}" if seeds else ""
    lines = [
        "# First results: the closed loop in real hands",
        "",
        f"Made by `micron hands{people_option}`, firmware revision {revision}; {seconds:g} s of virtual",
        f"time each, scored from {SETTLE_S:g} s after arming. Tremor: rms of the tip as a vector in 8-12 Hz on the",
        "physical truth, manipulator resting (without) and working (with). Each recorded hand is scaled to 50 um p-p",
        "in 8-12 Hz over the whole part that was chosen; the emulated instrument has all its sensor and actuator",
        "errors on.",
        "",
        "| hand | estimator | without (um rms) | with (um rms) | less (%) | limits: stroke, causal (%) "
        "| at a limit (% of ticks) | all bands, without -> with (um rms) | below 2 Hz | 2-8 Hz | 20-500 Hz |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        vector, whole = row.figures.vector, row.figures.whole_band
        before = vector.uncompensated_rms_um
        stroke, causal = (100.0 * (1.0 - left / before) for left in (row.stroke_limit_um, row.causal_limit_um))
        cells = (
            row.hand,
            row.method,
            f"{before:.2f}",
            f"{vector.compensated_rms_um:.2f}",
            f"{vector.reduction_percent:.1f}",
            f"{stroke:.1f}, {causal:.1f}",
            f"{row.limited_percent:.1f}",
            f"{whole.uncompensated_rms_um:.1f} -> {whole.compensated_rms_um:.1f}",
            *(
                f"{figures.uncompensated_rms_um:.1f} -> {figures.compensated_rms_um:.1f}"
                for figures in (row.figures.bands[BANDS_HZ[k]] for k in (0, 1, 3))
            ),
        )
        lines.append(f"| {' | '.join(cells)} |")
    best = {row.hand: row.figures.vector.reduction_percent for row in rows if row.method == METHODS[0]}
    missed = [hand for hand, less in best.items() if less < GOAL_PERCENT]
    short = [f"{hand} ({best[hand]:.1f} %)" for hand in missed]
    lines += [
        "",
        f"Goal: {GOAL_PERCENT:g} % with the default estimator, `{METHODS[0]}`: reached in {len(best) - len(short)} of "
        f"{len(best)} hands" + (f"; not in: {', '.join(short)}." if short else "."),
        "",
        "Limits: what the stroke alone would leave if the tremor were known beforehand, and what the best causal",
        "linear filter of the tip's acceleration leaves, fitted to this very hand and with sensor noise, if no stroke",
        "ended; `adaptive` sees the turns of the handle, too, and may leave less. Both limits at once leave",
        "more.",
        "",
        *(line for row in rows if row.hand in missed and row.method == METHODS[0] for line in (*explain_miss(row), "")),
        *_played_again(rows, seconds),
        *_unseen(rows),
        "Published for comparison: 69 % with WFLC alone in one dimension, sensing excluded (Ang 2004, section 5.2).",
        "All bands: error against the intended path. It holds what the instrument does not try to cancel: drift, jerks",
        "and everything below 2 Hz. At a limit: the wanted displacement was out of the manipulator's reach or the",
        "amplifier's range. Motion below the tremor band yields its stroke to the band, so its error can stay large.",
        "",
        *core_lines([row for row in rows if row.method == METHODS[0]]),
        *above_lines([row for row in rows if row.method == METHODS[0]]),
        *spectrum_lines([row for row in rows if row.method == METHODS[0]]),
        *(people_table(people, seeds) if people else ()),
    ]
    return "\n".join(lines)


def _played_again(rows: list[HandRow], seconds: float) -> list[str]:
    """List the hands shorter than a run, for which the estimator meets the same tremor more than once."""
    short = {row.hand: row.recorded_s for row in rows if row.recorded_s < seconds}
    if not short:
        return []
    named = ", ".join(f"{hand} ({length:.0f} s)" for hand, length in short.items())
    text = f"Records shorter than the run are played again from their start: {named}. There the estimator meets tremor "
    return [*wrap(text + "that it has met before in the same run.", 110), ""]


def _unseen(rows: Sequence[HandRow]) -> list[str]:
    """Say which part of a long record is scored and that no setting was chosen on it."""
    parts = dict.fromkeys(f"{row.hand} ({row.source.split('#')[1]} s)" for row in rows if row.source in UNSEEN)
    return [*wrap(f"No setting was chosen on the part that is scored: {', '.join(parts)}.", 110), ""] if parts else []


def above_lines(rows: Sequence[HandRow]) -> list[str]:
    """Return the section of the page on motion above 20 Hz: what adds to the hand's own, and what the strokes leave."""
    text = (
        f"um rms above 20 Hz, as vectors. Added: root of the power's difference to the hand's own. By the strokes: "
        "what their ends and the way motion yields to them add when the tremor is known beforehand; a better estimate "
        "of the same motion does not lower it. Room: what the goal then leaves to estimator and actuators. By the "
        "estimator: what it adds if no stroke ended and the actuators did exactly what it says. All these look once a "
        "millisecond, at the scan. At 8 kHz: the tip in every step of the plant, which alone shows the actuators' "
        f"resonance as it is; the goal, at most {GOAL_ABOVE_UM:g} um added ({GOAL_ABOVE_SYNTHETIC_UM:g} um on a "
        "synthetic hand), is judged there."
    )
    lines = [
        "## Motion above 20 Hz",
        "",
        *wrap(text, 110),
        "",
        "| hand | its own | with compensation | added | by the strokes | room | by the estimator "
        "| at 8 kHz: its own, with | added | goal |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|---|",
    ]
    for row in rows:
        if (a := row.above) is not None:
            tip, strokes, estimator = (a.added_um(um) for um in (a.tip_um, a.known_um, a.wish_um))
            goal_um = GOAL_ABOVE_UM if isfinite(row.recorded_s) else GOAL_ABOVE_SYNTHETIC_UM
            room = max(goal_um**2 - strokes**2, 0.0) ** 0.5
            cells = [f"{um:.2f}" for um in (a.hand_um, a.tip_um, tip, strokes, room, estimator)]
            fine = row.fine
            cells += ["-", "-"] if fine is None else [f"{fine.hand_um:.2f}, {fine.tip_um:.2f}", f"{fine.added_um:.2f}"]
            verdict = "met" if (tip if fine is None else fine.added_um) <= goal_um else "missed"
            lines.append(f"| {escaped(row.hand)} | {' | '.join(cells)} | {verdict} |")
    return [*lines, ""]


def core_lines(rows: Sequence[HandRow]) -> list[str]:
    """Return the section of the page on what strokes and estimator leave of the tremor, each alone."""
    text = (
        "um rms in 8-12 Hz, as vectors. By the strokes: left if the tremor were known beforehand, with strokes used as "
        "on the instrument: motion beyond them is made smaller instead of cut off, so that its corners do not shake "
        "the tip above 20 Hz. By the estimator: left if no stroke ended. Where both fail at the same time, what they "
        "leave adds up, and a better estimate cannot leave less than the strokes do."
    )
    lines = [
        "## Tremor that strokes and estimator leave",
        "",
        *wrap(text, 110),
        "",
        "| hand | without | with compensation | by the strokes | by the estimator | their sum | strokes allow (%) |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        if (c := row.core) is not None:
            figures = (c.hand_um, c.tip_um, c.known_um, c.wish_um, c.known_um + c.wish_um)
            allowed = 100.0 * (1.0 - c.known_um / c.hand_um)
            lines.append(f"| {escaped(row.hand)} | {' | '.join(f'{um:.2f}' for um in figures)} | {allowed:.1f} |")
    return [*lines, ""]


def spectrum_lines(rows: Sequence[HandRow]) -> list[str]:
    """Return the section of the page with the spectrum of each row's error, without and with compensation."""
    lines = [
        "## Spectrum of the error against the intended path",
        "",
        "Third octaves, um/sqrt(Hz), without -> with compensation; all of them are in the JSON.",
        "",
        f"| hand | {' | '.join(f'{hz:g} Hz' for hz in SHOWN_HZ)} |",
        f"|---|{'---|' * len(SHOWN_HZ)}",
    ]
    for row in rows:
        spectrum = row.figures.spectrum
        at = dict(zip(spectrum.hz, zip(spectrum.without_um_rtHz, spectrum.with_um_rtHz, strict=True), strict=True))
        cells = (" -> ".join(map(density_text, at[hz])) if hz in at else "-" for hz in SHOWN_HZ)
        lines.append(f"| {escaped(row.hand)} | {' | '.join(cells)} |")
    return [*lines, ""]


def escaped(name: str) -> str:
    """Return a name as a cell of a Markdown table."""
    return name.replace("|", "\\|")


def explain_miss(row: HandRow) -> list[str]:
    """Explain a hand that misses the goal by the figures alone."""
    vector, swing = row.figures.vector, row.swing
    sentences = [f"{row.hand[0].upper()}{row.hand[1:]}:"]
    if swing.rms_um > 3.0 * swing.rest_um > 0.0:
        sentences.append(
            f"{100.0 * swing.share:.0f} % of the tremor's power is one swing from {swing.start_s:.0f} to "
            f"{swing.start_s + swing.seconds:.0f} s after the start, {swing.rms_um:.0f} um rms against "
            f"{swing.rest_um:.1f} um in all the rest: it decides the figure, and the estimator meets it unprepared "
            "(the causal limit has seen it)."
        )
    elif swing.rest_um > 0.0:
        share = f"{100.0 * swing.share:.0f} % of the tremor's power"
        sentences.append(f"its strongest {swing.seconds:g} s hold {share}: no single swing.")
    least = 100.0 * (1.0 - row.stroke_limit_um / vector.uncompensated_rms_um)
    sentences.append(f"With the tremor known beforehand the stroke would allow {least:.1f} %;")
    sentences.append(f"the manipulator is at a limit in {row.limited_percent:.1f} % of the ticks.")
    return wrap(" ".join(sentences), 110)
