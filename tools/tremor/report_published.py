"""The page's part on published figures: the families of ``algorithms.md`` under that page's conditions."""

from __future__ import annotations

from collections.abc import Callable

from firmware_py.tremor.config import Method, TremorConfig
from tools.tremor.evaluate import OTHERS, Summary, evaluate, summarise
from tools.tremor.published import published_case
from tools.tremor.report import table
from tools.tremor.signal import TremorSignal

SEEDS = (201, 202, 203)
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
    "wflc_flc": (53.5, 57.4, 61.0, 65.7, 66.7),
    "bmflc_kalman": (45.9, 46.5, 47.5, 51.0, 53.2),
    "ar_kalman": (45.9, 45.8, 45.7, 45.6, 45.6),
}
JOINT = (33.8, 34.8, 34.9, 35.1, 36.3)
"""One Kalman filter of voluntary motion and oscillators: the best figure there."""
FLOOR = (20.0, 21.0, 21.6, 21.9, 21.9)


def _left(lines: list[Summary], method: str, horizon_ms: int) -> float:
    return next(x.all_percent for x in lines if x.method == method and x.horizon_ms == horizon_ms)


def section(signals: list[TremorSignal], progress: Callable[[str], None]) -> list[str]:
    """Markdown lines; the recordings are not used."""
    alone = TremorConfig(sees="displacement", isolated=True)
    ours: tuple[Method, ...] = (*ALONE, "adaptive")
    first = summarise(evaluate([published_case(1, s) for s in SEEDS], ours, ALONE_MS, alone, progress))
    ours = (*MIXED, "adaptive")
    second = summarise(evaluate([published_case(2, s) for s in SEEDS], ours, MIXED_MS, progress=progress))

    def row(name: str, method: str, lines: list[Summary], at: tuple[int, ...], published: tuple[float, ...] | None):
        found = [f"{_left(lines, method, h):.1f}" for h in at]
        peers = [f"{p:.1f}" for p in published] if published else ["-"] * len(at)
        return [name, *(f"{a} / {b}" for a, b in zip(found, peers, strict=True))]

    def head(at: tuple[int, ...]) -> list[str]:
        return ["ours / published", *(f"{h} ms" for h in at)]

    return [
        "## Published figures side by side",
        "",
        "Residual in percent of the tremor's rms, under the conditions of algorithms.md, part A (one axis,",
        "displacement at 1 kHz, three records of 20 s made as that page describes; its own generator is not",
        "published).",
        "",
        "Isolated tremor without noise:",
        "",
        *table(
            head(ALONE_MS),
            [row(m, m, first, ALONE_MS, p) for m, p in ALONE.items()]
            + [row("adaptive, beside the best of them (AR)", "adaptive", first, ALONE_MS, ALONE["ar_kalman"])],
        ),
        "",
        "Tremor 50 um in voluntary motion of 300 um rms, 1 um of noise:",
        "",
        *table(
            head(MIXED_MS),
            [row(m, m, second, MIXED_MS, p) for m, p in MIXED.items()]
            + [
                row("adaptive, beside the joint Kalman filter", "adaptive", second, MIXED_MS, JOINT),
                row("best fixed linear filter of other records", OTHERS, second, MIXED_MS, FLOOR),
            ],
        ),
        "",
        "Our band-pass and settings of the combiners are those of the instrument (acceleration, 7-13 Hz elliptic), not",
        "tuned for displacement records; that page tuned each on three records. BMFLC with Kalman weights and AR are",
        "therefore worse than published where voluntary motion is in. Our records are easier to separate than that",
        "page's (see the last row), so the adaptive row is to be read against the row below it and not as a ratio to",
        "the published one. Near-zero figures of AR belong to records without noise.",
    ]
