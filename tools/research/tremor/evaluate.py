"""Every estimator on every case at every horizon, beside the limit."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from firmware_py.tremor.adaptive_design import design_adaptive
from firmware_py.tremor.config import Method, TremorConfig
from firmware_py.tremor.estimator import Estimator
from hal.arrays import Array
from tools.research.tremor.bound import SKIP_S, wiener_bounds
from tools.research.tremor.cases import EMULATED, RATE_HZ, Case
from tools.research.tremor.scores import Score, score

OTHERS, ORACLE, UNSEEN = "limit: others", "limit: oracle", "limit: itself unseen"
LIMITS = (OTHERS, ORACLE, UNSEEN)
HORIZONS_MS = (0, 2, 8, 20)


@dataclass(frozen=True)
class Result:
    """Holds a method, case and horizon; ``frequency_error_hz``: median of the scored part, axis with most tremor."""

    group: str
    case: str
    subject: str
    method: str
    horizon_ms: int
    score: Score
    frequency_hz: float
    frequency_error_hz: float
    us_per_sample: float

    def as_dict(self) -> dict[str, Any]:
        flat = {k: v for k, v in asdict(self).items() if k != "score"}
        return {**flat, **asdict(self.score)}


def with_horizon(config: TremorConfig, case: Case, method: Method, horizon_ms: int) -> TremorConfig:
    """The instrument's configuration with another method, horizon and sensor."""
    changed: dict[str, Any] = {"method": method, "loop_delay_s": horizon_ms * 1e-3, "sees": case.sees}
    if case.sees == "displacement":
        changed["filter_cutoff_rad_s"] = float("inf")
    return config.model_copy(update=changed)


def run_case(case: Case, config: TremorConfig) -> tuple[Array, Array, float]:
    """Predictions (n, k), frequencies (n, k), us a sample (all axes)."""
    estimator = Estimator(config, axes=case.samples.shape[1])
    estimator.run(case.samples[:10])
    estimator.reset()
    start = time.perf_counter()
    estimate = estimator.run(case.samples)
    elapsed = time.perf_counter() - start
    return estimate.ahead_m, estimate.frequency_hz, 1e6 * elapsed / len(case.samples)


def evaluate(
    cases: Sequence[Case],
    methods: Sequence[Method],
    horizons_ms: Sequence[int] = HORIZONS_MS,
    config: TremorConfig | None = None,
    progress: Callable[[str], None] = lambda text: None,
) -> list[Result]:
    """Return all results; the limits are computed per group of cases with the same data."""
    base = config or TremorConfig()
    results: list[Result] = []
    groups: dict[tuple[str, str], list[Case]] = {}
    for case in cases:
        groups.setdefault((case.group, case.sees), []).append(case)
    for (group, _), members in groups.items():
        progress(f"{group}: limits")
        as_seen = with_horizon(base, members[0], "adaptive", 0)
        design = design_adaptive(as_seen)
        # recorded hands of other sets stand in for other people; the emulated ones are easier and do not
        elsewhere = [c for c in cases if c.group not in (group, EMULATED) and c.sees == members[0].sees]
        bounds = wiener_bounds(members, [round(h * 1e-3 * RATE_HZ) for h in horizons_ms], as_seen, elsewhere)
        for case, bound in zip(members, bounds, strict=True):
            nan = float("nan")
            for h in horizons_ms:
                ticks = round(h * 1e-3 * RATE_HZ)
                for name, found in zip(LIMITS, (bound.others, bound.oracle, bound.unseen), strict=True):
                    if ticks in found:
                        figures = score(case, found[ticks], ticks, design)
                        results.append(Result(group, case.name, case.subject, name, h, figures, nan, nan, nan))
                for method in methods:
                    if method == "kalman" and case.sees == "displacement":
                        continue
                    progress(f"{case.name}: {method}, {h} ms")
                    ahead, frequency, cost_us = run_case(case, with_horizon(base, case, method, h))
                    figures = score(case, ahead, ticks, design)
                    strongest = int(np.argmax(np.var(case.truth, axis=0)))
                    found_hz = float(np.median(frequency[round(SKIP_S * RATE_HZ) :, strongest]))
                    error_hz = abs(found_hz - case.frequency_hz)
                    results.append(
                        Result(group, case.name, case.subject, method, h, figures, found_hz, error_hz, cost_us)
                    )
    return results


@dataclass(frozen=True)
class Summary:
    """Means over the cases of one group; ``to_...``: ratios of mean lifted residuals to those of the limits."""

    group: str
    method: str
    horizon_ms: int
    cases: int
    all_percent: float
    band_percent: float
    lifted_percent: float
    worst_lifted_percent: float
    delay_ms: float
    slow_percent: float
    frequency_error_hz: float
    us_per_sample: float
    to_others: float
    to_oracle: float
    to_unseen: float


def summarise(results: Sequence[Result]) -> list[Summary]:
    """Return a line per group, method and horizon, in the order of the results."""
    table: dict[tuple[str, str, int], list[Result]] = {}
    for r in results:
        table.setdefault((r.group, r.method, r.horizon_ms), []).append(r)

    def mean(values: Sequence[float]) -> float:
        finite = [v for v in values if np.isfinite(v)]
        return float(np.mean(finite)) if finite else float("nan")

    lines: list[Summary] = []
    for (group, method, h), rows in table.items():
        lifted = mean([r.score.lifted_percent for r in rows])
        limits = [mean([r.score.lifted_percent for r in table.get((group, name, h), [])]) for name in LIMITS]
        lines.append(
            Summary(
                group,
                method,
                h,
                len(rows),
                mean([r.score.all_percent for r in rows]),
                mean([r.score.band_percent for r in rows]),
                lifted,
                max(r.score.lifted_percent for r in rows),
                mean([r.score.delay_ms for r in rows]),
                mean([r.score.slow_percent for r in rows]),
                mean([r.frequency_error_hz for r in rows]),
                mean([r.us_per_sample for r in rows]),
                *(lifted / limit for limit in limits),
            )
        )
    return lines
