"""The page's part on inspection: clocks, the shaker, the wrist, the hands on a mouse."""

from __future__ import annotations

import numpy as np

from tools.research.tremor.inspect import inspect
from tools.research.tremor.report import Progress, table
from tools.research.tremor.shaker import shaker_figures, wrist_figures
from tools.research.tremor.signal import TremorSignal


def section(signals: list[TremorSignal], progress: Progress) -> list[str]:
    """See ``report.SECTIONS``."""
    progress("shaker")
    shaker = shaker_figures(signals)
    lines = ["## Inspection", "", "### Shaker: 44 known frequencies", "", f"{shaker.clock}.", ""]
    lines += table(
        ["amplitude", "recordings", "largest error (Hz)", "rms error (Hz)"],
        [
            [name, str(len(e)), f"{np.max(np.abs(e)):.3f}", f"{np.sqrt(np.mean(e**2)):.3f}"]
            for name, e in shaker.error_hz.items()
        ],
    )
    lines += [
        "",
        f"Goal: 0.1 Hz at medium and high amplitude; found {shaker.worst_hz:.3f} Hz. With the stated rate",
        "believed it would",
        f"be {shaker.as_stated_hz:.3f} Hz. The 95 % intervals hold the drive frequency in",
        f"{100 * shaker.covered:.0f} % of all.",
        "At low amplitude the intervals exclude some of the named frequencies: the drive itself was elsewhere.",
        "",
        "### Wrist of a person with Parkinson's disease",
        "",
    ]
    progress("wrist")
    (wrist,) = (s for s in signals if s.reference.windows is not None)
    figures, _ = wrist_figures(wrist)
    low, high = figures.share_to_be_90
    lines += table(
        ["limit of the share", "sensitivity (%)", "specificity (%)"],
        [
            ["0.3, the rule", f"{100 * figures.sensitivity:.1f}", f"{100 * figures.specificity:.1f}"],
            [
                "chosen on nine tenths, judged on the tenth left out",
                f"{100 * figures.held_out_sensitivity:.1f}",
                f"{100 * figures.held_out_specificity:.1f}",
            ],
        ],
    )
    error = np.abs(figures.frequency_error_hz)
    lines += [
        "",
        f"{figures.windows} windows of 4 s, {figures.with_tremor} with tremor by the reference, a",
        "classifier's result and not a",
        f"clinician's. Limits from {low:.3f} to {high:.3f} give 90 % of both: the range is narrow and one window is",
        f"{100 / figures.with_tremor:.0f} % of sensitivity. Peak frequency in the reference's tremor",
        "windows: median difference",
        f"{np.median(error):.2f} Hz, within 0.35 Hz in {100 * figures.frequency_near:.0f} % (the",
        "reference's grid is 0.25 Hz).",
        "",
        "### Hands on a mouse",
        "",
    ]
    rows: list[list[str]] = []
    for s in (s for s in signals if s.quantity == "angular rate" and s.reference.windows is None):
        progress(s.name)
        found = inspect(s)
        rows.append(
            [
                f"{s.name}{', essential tremor' if s.reference.tremor else ''}",
                f"{s.rate_hz:.2f}",
                f"{100 * found.tremor_share:.0f}",
                f"{found.peak_hz:.2f} ({found.low_hz:.2f} to {found.high_hz:.2f})" if found.steady else "not steady",
                f"{1e3 * found.excursion:.3f}",
            ]
        )
    lines += table(["signal", "rate (Hz)", "windows with tremor (%)", "peak, 95 % (Hz)", "amplitude (mrad)"], rows)
    lines += [
        "",
        "The host's time stamps jitter by 3 to 13 ms and the samples do not: what the gyroscope saw",
        "between two samples does",
        "not follow the stamps at all. So the samples are taken as even on a slowly varying clock;",
        "interpolating at the",
        "stamps instead doubles the power above 20 Hz. The share of tremor windows does not tell who has",
        "essential tremor:",
        "it counts windows in which tremor is a third of all motion, and these hands move.",
    ]
    return lines
