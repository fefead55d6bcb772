"""When the guardian's process steps: a millisecond after the last step at the latest, and beside no computation."""

from __future__ import annotations

import random

import pytest

from firmware_py.guardian.guardian import STEP_NS
from firmware_py.guardian.process import STEP_DELAY_NS, compute_pause_ns

STEP_COST_NS = 45_000
"""From the end of a pause to the begin of the next one: the process wakes late, and a step takes time."""


def test_no_pause_is_longer_than_a_step_or_shorter_than_half_of_one():
    beats = (0, 7_000_000, 9_000_000, *range(5_000_000, 7_000_000, 9_973))
    pauses = [compute_pause_ns(beat_ns, 7_000_000) for beat_ns in beats]
    assert max(pauses) <= STEP_NS
    assert min(pauses) >= STEP_NS // 2


@pytest.mark.parametrize("offset_ns", range(0, STEP_NS, 50_000))
def test_steps_come_while_the_loop_waits_for_its_bus(offset_ns: int):
    """Commands come every millisecond, up to 40 us early or late, from any phase of the steps."""
    jitter = random.Random(offset_ns)
    beats = [offset_ns + k * STEP_NS + jitter.randrange(-40_000, 40_000) for k in range(60)]
    now_ns, after_ns = offset_ns, list[int]()
    while now_ns < beats[-1]:
        beat_ns = max((beat for beat in beats if beat <= now_ns), default=0)
        now_ns += compute_pause_ns(beat_ns, now_ns)
        after_ns.append(now_ns - max(beat for beat in beats if beat <= now_ns))
        now_ns += STEP_COST_NS
    settled = after_ns[20:]
    assert len(settled) > 30
    assert all(abs(each - STEP_DELAY_NS) < 130_000 for each in settled), settled
