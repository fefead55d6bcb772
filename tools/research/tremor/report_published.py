"""The page's part on published figures: the families of ``algorithms.md`` under that page's conditions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import inf
from typing import Any

from firmware_py.tremor.adaptive_design import design_adaptive
from firmware_py.tremor.config import Method, TremorConfig
from tools.research.tremor.bound import wiener_bounds
from tools.research.tremor.cases import RATE_HZ, Case
from tools.research.tremor.evaluate import run_case, with_horizon
from tools.research.tremor.published import band_passed, held, published_case, two_hundred_taps
from tools.research.tremor.report import table
from tools.research.tremor.scores import score
from tools.research.tremor.signal import TremorSignal

SEEDS = (201, 202, 203, 204, 205)
TRAINING = tuple(range(301, 321))
ALONE_MS = (1, 4, 8, 16, 20)
MIXED_MS = (0, 4, 8, 16, 20)
# residual, percent: algorithms.md, part A, "Measured"
ALONE: dict[Method, tuple[float, ...]] = {
    "wflc_flc": (12.6, 16.4, 21.0, 27.6, 29.3),
    "bmflc": (21.1, 62.2, 84.9, 96.3, 97.6),
    "ebmflc": (9.5, 18.5, 29.7, 46.0, 50.1),
    "bmflc_kalman": (0.5, 2.2, 5.1, 13.1, 17.6),
    "ar_kalman": (0.0, 0.2, 0.5, 1.9, 2.9),
}
MIXED: dict[Method, tuple[float, ...]] = {
    "wflc_flc": (44.2, 49.9, 56.8, 61.5, 62.7),
    "bmflc_kalman": (40.4, 39.9, 41.2, 57.8, 68.4),
    "ar_kalman": (45.9, 45.8, 45.7, 45.6, 45.6),
}
"""The first two with the band-pass's phase undone, as ours do."""
JOINT = (33.8, 34.8, 34.9, 35.1, 36.3)
"""One Kalman filter of voluntary motion and oscillators: the best figure there."""
FLOOR = (20.0, 21.0, 21.6, 21.9, 21.9)
HELD = (6.2, 24.7, 49.0, 94.7, 115.5)
BAND_PASS = (45.9, 60.6, 78.3, 114.2, 130.5)
_COMB = {"low_hz": 8.0, "high_hz": 12.0, "step_hz": 0.25, "bias_walk": 0.0}  # 17 frequencies, as there
_BAND = {"low_hz": 6.0, "high_hz": 14.0, "prefilter": "butterworth", "prefilter_order": 1}
TUNED_ALONE: dict[Method, Mapping[str, Any]] = {
    "bmflc": {"own": {**_COMB, "gain": 0.01}},
    "ebmflc": {"own": {"memory_gain": 0.02}},
    "bmflc_kalman": {"own": {**_COMB, "walk": 3.0}},
    "ar_kalman": {"own": {"spacing_s": 0.001, "walk": 1e-3, "noise": 1e-4}},
}
TUNED_MIXED: dict[Method, Mapping[str, Any]] = {
    "wflc_flc": {"wflc": _BAND},
    "bmflc_kalman": {"wflc": _BAND, "own": {**_COMB, "walk": 0.005}},
    "ar_kalman": {"wflc": _BAND, "own": {"walk": 1e-5, "noise": 0.3}},
    "adaptive": {"adaptive": {"cancel_from_hz": (5.0, 7.0), "cancel_to_hz": (13.0, 16.0)}},
}
"""As that page did, by a small grid, on at most three records: seeds 211 to 213; AR 211 and 212; with voluntary
motion AR, E-BMFLC and Kalman weights 211 alone."""


def tuned(config: TremorConfig, changes: Mapping[str, Any]) -> TremorConfig:
    """``config`` with ``changes``: tables of ``TremorConfig`` by name, key by key, and ``own`` as a whole."""
    tables = {k: v if k == "own" else getattr(config, k).model_copy(update=v) for k, v in changes.items()}
    return config.model_copy(update=tables)


def left(cases: Sequence[Case], config: TremorConfig, method: Method, horizons_ms: Sequence[int]) -> list[float]:
    """Mean residual over ``cases``, percent of the tremor's rms, per horizon."""
    design = design_adaptive(config)
    found: list[float] = []
    for h in horizons_ms:
        ticks = round(h * 1e-3 * RATE_HZ)
        each = [score(c, run_case(c, with_horizon(config, c, method, h))[0], ticks, design) for c in cases]
        found.append(sum(s.all_percent for s in each) / len(each))
    return found


def section(signals: list[TremorSignal], progress: Callable[[str], None]) -> list[str]:
    """Markdown lines; the recordings are not used."""
    alone = TremorConfig(sees="displacement", isolated=True, filter_cutoff_rad_s=inf)
    mixed = TremorConfig(sees="displacement", filter_cutoff_rad_s=inf)
    first, second = ([published_case(task, s) for s in SEEDS] for task in (1, 2))
    training = [published_case(2, s) for s in TRAINING]

    def row(name: str, found: Sequence[float], published: Sequence[float]) -> list[str]:
        return [name, *(f"{a:.1f} / {b:.1f}" for a, b in zip(found, published, strict=True))]

    def families(
        cases: Sequence[Case],
        config: TremorConfig,
        known: Mapping[Method, Sequence[float]],
        settings: Mapping[Method, Mapping[str, Any]],
        at: Sequence[int],
    ) -> list[list[str]]:
        rows: list[list[str]] = []
        for method, published in known.items():
            progress(f"{method}, {cases[0].group}")
            name = f"{method}, {'its defaults' if method == 'adaptive' else 'as on the instrument'}"
            rows.append(row(name, left(cases, config, method, at), published))
            if method in settings:
                found = left(cases, tuned(config, settings[method]), method, at)
                rows.append(row(f"{method}, tuned as there", found, published))
        return rows

    def head(at: Sequence[int]) -> list[str]:
        return ["ours / published", *(f"{h} ms" for h in at)]

    def bank(ticks: int) -> float:
        bounds = wiener_bounds(second, [ticks], mixed)
        design = design_adaptive(mixed)
        each = [score(c, b.others[ticks], ticks, design).all_percent for c, b in zip(second, bounds, strict=True)]
        return sum(each) / len(each)

    return [
        "## Published figures side by side",
        "",
        "Residual in percent of the tremor's rms, under the conditions of algorithms.md, part A (one axis,",
        f"displacement at 1 kHz, {len(SEEDS)} records of 20 s made as that page describes). Its own generator is not",
        "published, but three of its figures need no estimator and tell whether the records are alike:",
        "",
        *table(
            ["ours / published", "0 ms", "1 ms", "4 ms", "8 ms", "16 ms", "20 ms"],
            [
                _spread("last value held, tremor alone", ALONE_MS, [held(first, h) for h in ALONE_MS], HELD),
                _spread("band-pass alone", MIXED_MS, [band_passed(second, h) for h in MIXED_MS], BAND_PASS),
                _spread(
                    "best 200 taps of 20 other records",
                    MIXED_MS,
                    [two_hundred_taps(second, training, h) for h in MIXED_MS],
                    FLOOR,
                ),
            ],
        ),
        "",
        "Isolated tremor without noise:",
        "",
        *table(
            head(ALONE_MS),
            [
                *families(first, alone, ALONE, TUNED_ALONE, ALONE_MS),
                row(
                    "adaptive, beside the best of them (AR)",
                    left(first, alone, "adaptive", ALONE_MS),
                    ALONE["ar_kalman"],
                ),
            ],
        ),
        "",
        "Tremor 50 um in voluntary motion of 300 um rms, 1 um of noise:",
        "",
        *table(
            head(MIXED_MS),
            [
                *families(second, mixed, MIXED, TUNED_MIXED, MIXED_MS),
                *families(second, mixed, {"adaptive": JOINT}, TUNED_MIXED, MIXED_MS),
                row("best fixed filter of the other records, 0.6 s", [bank(h) for h in MIXED_MS], FLOOR),
            ],
        ),
        "",
        "As on the instrument: settings and band-pass of the instrument (acceleration, 7-13 Hz elliptic, order 6),",
        "which were never meant for displacement. Tuned as there: that page tuned each family on three records;",
        "so are these, on at most three others (seeds 211 to 213; AR on two of them, and with voluntary motion AR,",
        "E-BMFLC and Kalman weights on one alone), by a small grid, behind that page's band-pass (6-14 Hz, first",
        "order).",
        "The phase of the band-pass is undone in ours; the published WFLC-FLC and BMFLC with Kalman weights are those",
        "with the phase undone. The adaptive method stands beside that page's best, the joint Kalman filter of",
        "voluntary motion and oscillators; by its defaults all of 2 to 20 Hz is to be cancelled (less by the preset of",
        "the benches),",
        "and a third of that is this voluntary motion's tail; tuned as there, it is told that tremor lies in 5 to 16",
        "Hz. Near-zero",
        "figures of AR belong to records without noise.",
    ]


def _spread(name: str, at: Sequence[int], found: Sequence[float], published: Sequence[float]) -> list[str]:
    cells = {h: f"{a:.1f} / {b:.1f}" for h, a, b in zip(at, found, published, strict=True)}
    return [name, *(cells.get(h, "-") for h in (0, 1, 4, 8, 16, 20))]
