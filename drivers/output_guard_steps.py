"""Computes limits, slew and ramp of the output guard, in the interpreter and compiled, over the same memory.

The functions read no clock and raise nothing. The interpreter runs them over ``array``, whose items are plain Python
numbers, because a numpy item costs more than the arithmetic. Compiled code uses that memory through
``GuardState.view``. This module imports no numba, because the guardian's process and short commands drive outputs
without it; a compiled loop gives the functions to ``hal.compiled.kernel``.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from hal.types import OutputLimit

RAMP_STEPS = 16
"""Number of ramp steps (1 ms each). It leaves 4 of the 20 ms until neutral for transfers that must be repeated."""

KEPT = 17
"""Number of sent commands that are kept. A reader beside the writer can rely on all but the oldest."""

(
    ARMED, WRITES, CLIPPED, SLEW_LIMITED, SENT_NS, OFFERED_NS, RAMP_DONE, RAMP_NEXT, RAMP_START_NS, RAMP_LONGEST,
    N_RAMP_STEPS, N_SENT, WORDS,
) = range(13)  # fmt: skip
"""Places in ``GuardState.words``. ``RAMP_DONE``: number of ramp steps that were sent, -1 without a ramp.
``N_SENT``: number of commands that were kept so far."""
LONGEST_GAP_S, RAMP_STEP_NS, TIMES = range(3)
"""Places in ``GuardState.times``."""
NOT_ARMED, NOT_FINITE = -1, -2
"""Refusals by ``admit``. The wish for channel i was not finite: ``NOT_FINITE - i``."""


class GuardState(NamedTuple):
    """Holds all that a guard knows: ``words`` and ``times`` as named above, the others one value per channel, V.

    Command n is kept at place ``n % KEPT``: ``kept_ns`` (2 * KEPT,) when it was offered and sent, ``kept_V``
    (channels * KEPT,) its volts."""

    words: Any
    kept_ns: Any
    times: Any
    kept_V: Any
    last_V: Any
    next_V: Any
    ramp_from_V: Any
    lo_V: Any
    hi_V: Any
    slew_V_per_s: Any
    safe_V: Any

    def view(self) -> GuardState:
        """Return numpy arrays over the same memory, for compiled code."""
        words, kept_ns, *others = self
        volts = (np.frombuffer(part, np.float64) for part in others)
        return GuardState(np.frombuffer(words, np.int64), np.frombuffer(kept_ns, np.int64), *volts)


def new_state(
    limits: Sequence[OutputLimit], now_ns: int, ramp_steps: int, ramp_step_s: float, longest_gap_s: float
) -> GuardState:
    """Return the state of outputs that rest at their safe values."""
    words = array("q", bytes(8 * WORDS))
    words[SENT_NS] = words[OFFERED_NS] = now_ns
    words[RAMP_DONE], words[RAMP_LONGEST], words[N_RAMP_STEPS] = -1, 1, ramp_steps
    safe_V = [limit.safe_V for limit in limits]
    return GuardState(
        words, array("q", bytes(16 * KEPT)), array("d", [longest_gap_s, ramp_step_s * 1e9]),
        array("d", bytes(8 * KEPT * len(safe_V))), array("d", safe_V), array("d", safe_V),
        array("d", safe_V), array("d", [limit.lo_V for limit in limits]), array("d", [limit.hi_V for limit in limits]),
        array("d", [limit.slew_V_per_s for limit in limits]), array("d", safe_V),
    )  # fmt: skip


def admit(state: GuardState, wishes_V: Any, now_ns: int) -> int:
    """Fill ``next_V`` from ``wishes_V``, one per channel. Return a bit mask of the channels that were clipped or slew
    limited, or a negative refusal, which leaves ``next_V`` as it was."""
    words = state.words
    if words[ARMED] == 0:
        return NOT_ARMED
    for i in range(len(state.last_V)):
        if not math.isfinite(wishes_V[i]):
            return NOT_FINITE - i
    words[OFFERED_NS] = now_ns
    gap_s = (now_ns - words[SENT_NS]) * 1e-9
    if gap_s > state.times[LONGEST_GAP_S]:
        gap_s = state.times[LONGEST_GAP_S]
    mask = 0
    for i in range(len(state.last_V)):
        value = wishes_V[i]
        if value < state.lo_V[i]:
            value = state.lo_V[i]
            words[CLIPPED] += 1
            mask |= 1 << i
        elif value > state.hi_V[i]:
            value = state.hi_V[i]
            words[CLIPPED] += 1
            mask |= 1 << i
        last = state.last_V[i]
        step = state.slew_V_per_s[i] * gap_s
        if value > last + step:
            value = last + step
            words[SLEW_LIMITED] += 1
            mask |= 1 << i
        elif value < last - step:
            value = last - step
            words[SLEW_LIMITED] += 1
            mask |= 1 << i
        state.next_V[i] = value
    words[RAMP_DONE] = -1
    return mask


def next_ramp_step(state: GuardState, now_ns: int) -> bool:
    """Disarm and fill ``next_V`` with the next step of the ramp. Return True if that is the safe state itself."""
    words = state.words
    words[ARMED] = 0
    words[OFFERED_NS] = now_ns
    n = len(state.last_V)
    if words[RAMP_DONE] < 0:
        steps = words[N_RAMP_STEPS]
        fewest = steps
        for i in range(n):
            state.ramp_from_V[i] = state.last_V[i]
            step_V = abs(state.last_V[i] - state.safe_V[i]) / steps
            if step_V > 0.0:
                fewest = min(fewest, int(state.slew_V_per_s[i] * state.times[RAMP_STEP_NS] * 1e-9 / step_V))
        words[RAMP_DONE] = 0
        words[RAMP_START_NS] = now_ns
        words[RAMP_LONGEST] = max(1, fewest)  # steps that the slew limit allows at once
    due = 1 + round((now_ns - words[RAMP_START_NS]) / state.times[RAMP_STEP_NS])
    done = words[RAMP_DONE]
    words[RAMP_NEXT] = min(max(due, done + 1), done + words[RAMP_LONGEST])
    part = words[RAMP_NEXT] / words[N_RAMP_STEPS]
    is_safe = True
    for i in range(n):
        start, safe = state.ramp_from_V[i], state.safe_V[i]
        state.next_V[i] = safe if part >= 1.0 else start + (safe - start) * part
        is_safe = is_safe and start == safe
    return part >= 1.0 or is_safe


def note_sent(state: GuardState, sent_ns: int) -> None:
    """Note, and keep in the list of commands, that ``next_V`` was sent at ``sent_ns`` (bench clock)."""
    words = state.words
    for i in range(len(state.last_V)):
        state.last_V[i] = state.next_V[i]
    words[SENT_NS] = sent_ns
    if words[RAMP_DONE] >= 0:
        words[RAMP_DONE] = words[RAMP_NEXT]
    else:
        words[WRITES] += 1
    n, place = len(state.last_V), words[N_SENT] % KEPT
    state.kept_ns[2 * place] = words[OFFERED_NS]
    state.kept_ns[2 * place + 1] = sent_ns
    for i in range(n):
        state.kept_V[n * place + i] = state.last_V[i]
    words[N_SENT] += 1  # last: a reader beside the writer believes only what is counted
