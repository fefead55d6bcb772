"""One step for the live loop, replay and batches: the same bits however it is called."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_py.actuation.config import ActuationConfig
from firmware_py.control.stages import StageConfigs, Stages
from firmware_py.frame import (
    CLIP,
    COMMAND,
    COUNTS,
    LAYOUT,
    MAGNETOMETER_FRESH,
    MAGNETOMETER_RAW,
    STATUS,
    TICK,
    VOLTS,
    Clip,
)
from firmware_py.frame import FrameStatus as S
from firmware_py.sensing.config import SensingConfig
from firmware_py.tremor.config import TremorConfig
from tests.unit.allocations import allocations

Rows = NDArray[np.float64]
N = 900


def test_all_memories_are_of_one_dtype():
    """Of one object: numba would otherwise compare two equal ones at every call, 100 us long (see ``chain``)."""
    configs = StageConfigs(SensingConfig(), TremorConfig(), ActuationConfig())
    assert Stages(configs).memory.dtype is Stages(configs).memory.dtype


def scans(n: int) -> Rows:
    """A trembling instrument: aligned after 80 ticks, commanded from tick 500 on, with everything that can happen."""
    rows = np.zeros((n, LAYOUT.size))
    t = np.arange(n) / 1000.0
    level = np.array([12400, 11600, 17300, 11200, 12000, 17100, 16270, 4747])
    wave = 60.0 * np.sin(2 * np.pi * 10.0 * t)[:, None] * np.array([1, -1, 0.5, 1, 2, -2, 0, 0])
    rows[:, COUNTS : COUNTS + 8] = np.round(level + wave)
    rows[:, TICK] = np.arange(n)
    rows[::10, MAGNETOMETER_FRESH] = 1.0
    rows[:, MAGNETOMETER_RAW : MAGNETOMETER_RAW + 3] = (2.62, 2.39, 2.93)
    rows[500:, STATUS] = S.COMMANDED
    rows[600, STATUS] = S.STALE | S.COMMANDED
    rows[650:660, STATUS] = S.MANUAL
    rows[650:660, COMMAND : COMMAND + 3] = 50.0 + np.arange(10)[:, None]
    rows[700:, TICK] += 3
    rows[700, STATUS] = S.GAP | S.COMMANDED
    rows[720, COUNTS] = np.nan
    rows[720, STATUS] = 0.0
    return rows


def stages() -> Stages:
    return Stages(StageConfigs(SensingConfig(), TremorConfig(settle_s=0.3), ActuationConfig()))


def live(rows: Rows) -> Rows:
    """As the loop does it: inputs into the frame, a wish, one call."""
    one = stages()
    frames = np.empty_like(rows)
    for k, row in enumerate(rows):
        one.frame[:VOLTS] = row[:VOLTS]
        one.frame[STATUS] = int(row[STATUS]) & (S.GAP | S.STALE)
        if int(row[STATUS]) & S.COMMANDED:
            one.command()
        elif int(row[STATUS]) & S.MANUAL:
            one.follow(row[COMMAND : COMMAND + 3])
        one.step()
        frames[k] = one.frame
    return frames


def test_a_batch_has_the_bits_of_the_live_loop() -> None:
    expected = live(scans(N))
    rows = scans(N)
    many = stages()
    for part in np.split(rows, [1, 333, 601, 655]):  # the memory goes on from piece to piece
        many.run(part)
    assert np.array_equal(rows.view(np.uint64), expected.view(np.uint64))
    status = expected[:, STATUS].astype(int)
    # what the comparison is worth: the rows did go through every branch
    assert status[720] & S.INVALID
    assert np.ptp(expected[500:600, COMMAND]) > 0.0
    assert np.array_equal(expected[650:660, COMMAND], 50.0 + np.arange(10))
    assert np.array_equal(expected[720, COMMAND : COMMAND + 3], expected[719, COMMAND : COMMAND + 3])


def test_what_a_batch_wrote_is_what_a_batch_finds_again() -> None:
    """A recording is such rows: outputs in them change nothing, and a rerun gives the same bits."""
    rows = scans(N)
    stages().run(rows)
    again = rows.copy()
    stages().run(again)
    assert np.array_equal(again.view(np.uint64), rows.view(np.uint64))


def test_without_a_wish_nothing_is_commanded() -> None:
    rows = scans(N)
    rows[:, STATUS] = 0.0
    stages().run(rows)
    assert not rows[:, COMMAND : COMMAND + 3].any()
    assert np.abs(rows[-1, LAYOUT["tremor"]]).max() > 0.0


def test_warming_up_leaves_no_trace() -> None:
    warm = stages()
    warm.warm_up()
    fresh = stages()
    assert warm.memory.tobytes() == fresh.memory.tobytes()
    assert not warm.frame.any()


def test_a_step_allocates_nothing() -> None:
    """Also not where it follows a hand-chosen command, meets a bad reading or an unreachable tip; aligning may.

    A call from Python wraps the two arrays that it hands over: one tick and seven hundred ask for the same.
    """
    one = stages()
    rows = scans(N)
    one.run(rows[:200])
    one.actuation.params["gain"] = 100.0  # far beyond what the manipulator can follow
    asked = []
    for part in (rows[200:201], rows[201:]):
        before = allocations()
        one.run(part)
        asked.append(allocations() - before)
    assert asked == [2, 2]
    assert np.any(rows[800:, CLIP].astype(int) & int(Clip.WORKSPACE))
