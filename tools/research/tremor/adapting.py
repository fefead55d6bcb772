"""Measures how fast an estimator learns a new hand: a stretch of a record is scored after more or less time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from firmware_py.tremor.adaptive_design import design_adaptive
from firmware_py.tremor.config import TremorConfig
from tools.numbers import vector_rms
from tools.research.tremor.bound import lift
from tools.research.tremor.cases import RATE_HZ, Case
from tools.research.tremor.evaluate import run_case, with_horizon
from tools.research.tremor.scores import residual

AT_S = 20.0
WINDOW_S = 5.0
LEADS_S = (2.0, 3.0, 5.0, 10.0, 20.0)
"""Time with the hand before the stretch; the last one stands for a hand that is known."""


def lifted_after(case: Case, lead_s: float, horizon_ms: int, config: TremorConfig) -> float:
    """m rms, lifted, left of the stretch ``AT_S`` .. + ``WINDOW_S`` by an estimator started ``lead_s`` before it.

    Raises ValueError for a case that is too short.
    """
    start, stop = (round(t * RATE_HZ) for t in (AT_S - lead_s, AT_S + WINDOW_S))
    if len(case.samples) < stop or start < 0:
        raise ValueError(f"{case.name}: {case.seconds:.1f} s; {AT_S + WINDOW_S:g} s are needed")
    part = replace(case, samples=case.samples[start:stop], truth=case.truth[start:stop], slow=None)
    ahead, _, _ = run_case(part, with_horizon(config, case, "adaptive", horizon_ms))
    # lifted as of the whole record, so that every lead is scored by the same ringing-in
    left = case.truth[:stop].copy()
    left[start:] = residual(part, ahead, round(horizon_ms * 1e-3 * RATE_HZ))
    scored = lift(left, design_adaptive(with_horizon(config, case, "adaptive", 0)))[-round(WINDOW_S * RATE_HZ) :]
    return vector_rms(scored)


def adapting(cases: Sequence[Case], horizon_ms: int, config: TremorConfig | None = None) -> dict[str, list[float]]:
    """Per case that is long enough: residual after each of ``LEADS_S`` over that after the last one."""
    out: dict[str, list[float]] = {}
    for case in cases:
        if case.seconds < AT_S + WINDOW_S:
            continue
        left = [lifted_after(case, lead, horizon_ms, config or TremorConfig()) for lead in LEADS_S]
        out[case.name] = [x / left[-1] for x in left]
    return out
