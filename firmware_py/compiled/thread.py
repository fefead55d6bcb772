"""The compiled thread: waits, reads, decodes, checks, steps, guards, encodes, writes and publishes without the GIL.

It runs the functions and kernels of the Python loop over the same memory. A block of scans that is lost, late beyond
the limit, shifted or implausible, a port that fails and an answer that is a complaint are handed over to Python as they
are. What it does alone is the ramp to neutral when Python has been silent for ``BEAT_LIMIT_NS``.
Importing this module imports numba. It imports little else, because a change of what it imports compiles it anew.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.daq.di4108_kernels import READY, WAIT, accept, decode
from drivers.piezo.e727_loop import HANDED_OVER, SENT
from firmware_py.compiled.memory import (
    ACTUATE,
    ARRIVAL_NS,
    BEAT_LIMIT_NS,
    BEAT_NS,
    BLOCK_LOST,
    BLOCK_N,
    BLOCK_SEQ,
    BLOCK_SHIFTED,
    BLOCK_T0_NS,
    BUDGET_NS,
    BUSY,
    CALLED,
    CAUGHT_UP,
    CLIPPED,
    COMMANDS,
    DAQ_FD,
    DEADLINE_NS,
    DEAF,
    DONE_ROW,
    DONE_STAGE,
    DT_NS,
    END_NS,
    ESTIMATE,
    FIXED_NS,
    FOUND,
    GAP,
    GAP_DUE_NS,
    GAP_NOW_NS,
    GO,
    LAST_DUE_NS,
    LAST_K,
    LATE_LIMIT_NS,
    LATE_NS,
    NOTE_ROOM,
    NOTES,
    ORDER,
    OUTPUT_FD,
    OVERRUNS,
    PAIR_TOLD,
    PERIOD_NS,
    PUBLISH,
    PUT_OFF,
    READ_FAILED,
    READS_LEFT,
    REAL_TIME,
    RECEIVED,
    REST,
    RUNS,
    SCANS,
    SCANS_LATE_NS,
    SENSE,
    SEQ_OF_TICK0,
    SILENT,
    SILENT_AT_NS,
    SILENT_OF_NS,
    SKIPPED,
    SLIPS,
    SPENT,
    SPIN_NS,
    SPUN_NS,
    STALE_NS,
    STALLED_NS,
    STARTED_NS,
    STREAM,
    STUCK,
    SUPERSEDED,
    TICKS,
    VERDICT,
    VERIFY,
    VERIFY_DIVIDER,
    VERIFY_END_NS,
    VERIFY_PATIENCE,
    VERIFY_PHASE,
    VERIFY_WAITED,
    WAITS_SINCE_NS,
    WAKE_FD,
    WARNED,
    Memory,
    Timing,
    Words,
)
from firmware_py.compiled.outputs import is_stuck, step_ramp, verify, write
from firmware_py.control.chain import COMMANDED, learn_after_step, step_kernel
from firmware_py.control.fresh_field import fill_field
from firmware_py.control.plausibility import CheckState, check_frame, check_scan
from firmware_py.frame import CLIP, CLIP_YIELD, COMMAND, COUNTS, DRIFT, INVALID, JERK, STALE, STATUS, TICK, TIME
from firmware_py.live.memory import announce, put_over
from firmware_py.recording.ring import announce_row, put_row
from firmware_py.scheduler.histogram import add_duration
from firmware_py.scheduler.ticker import ROUNDING_NS, silent_at_ns
from hal.compiled import inlined_kernel, kernel, thread_kernel
from hal.fd_kernels import (
    EAGAIN,
    POLLIN,
    is_ready,
    now_ns,
    poll_word,
    read_fd,
    release_fence,
    sleep_until_ns,
    wait_fds,
)

count_duration = kernel(add_duration)
fill = kernel(fill_field)
silent_at = kernel(silent_at_ns)
ring_put, ring_announce = kernel(put_row), kernel(announce_row)
live_put, live_announce = kernel(put_over), kernel(announce)

ARRIVAL_STEP_NS = 2000
"""Change of the running median with each arrival: from 0 to 200 us in a tenth of a second at 1 kHz."""
RAMP_LIMIT = 64
"""Largest number of steps of the thread's own ramp, ten times as many as it needs: a port that is stuck ends it."""


@kernel
def clock_ns(words: Words) -> int:
    """Return the time, the one that virtual time has fixed where there is one."""
    return now_ns() if words[FIXED_NS] == REAL_TIME else words[FIXED_NS]


@kernel
def save(check: CheckState, saved: Words, back: bool) -> None:
    """Copy the state that ``check_scan`` changes to ``saved``, or back."""
    at = 0
    for part in (check.last, check.same, check.slope, check.odd):
        for i in range(len(part)):
            if back:
                part[i] = saved[at]
            else:
                saved[at] = part[i]
            at += 1
    if back:
        check.tick, check.together = saved[at], saved[at + 1]
    else:
        saved[at], saved[at + 1] = check.tick, check.together


@kernel
def sense(m: Memory, frame: NDArray[np.float64], row: int, k: int, due_ns: int) -> bool:
    """Do what ``Micron.sense`` does with a scan. Return False, and leave the checks as they were, if it is
    implausible."""
    scan = m.rows[row]
    frame[TIME] = (due_ns - m.words[STARTED_NS]) * 1e-9
    frame[TICK] = k
    frame[STATUS] = 0
    for i in range(len(scan)):
        frame[COUNTS + i] = scan[i]
    save(m.check.state[0], m.saved, False)
    if check_scan(scan, k, m.check) != 0:
        save(m.check.state[0], m.saved, True)
        return False
    fill(frame, m.field, m.fresh)
    return True


@inlined_kernel
def estimate(m: Memory, frame: NDArray[np.float64], k: int, newest: bool) -> int:
    """Do what ``Micron.estimate`` does while the outputs may move. Return the number of a pair that disagrees
    permanently, else 0."""
    words = m.words
    if newest:
        frame[STATUS] = int(frame[STATUS]) | COMMANDED
    step_kernel(m.step)
    bits = int(frame[STATUS])
    if bits & (INVALID | STALE) == 0:
        found = check_frame(frame, m.check)
        if found > 0:
            return found
        if found < 0:
            words[PAIR_TOLD] = -found
    bits &= JERK | DRIFT
    rising = bits & ~words[WARNED]
    if rising != 0:
        note = m.notes[words[NOTES] % NOTE_ROOM]
        note[0], note[1] = rising, k
        words[NOTES] += 1
    words[WARNED] = bits
    return 0


@kernel
def actuate(m: Memory, frame: NDArray[np.float64], k: int, due_ns: int) -> bool:
    """Do what ``Micron.actuate`` does while the outputs may move. Return False if Python must do it."""
    words = m.words
    result, mask = write(m.output, words[OUTPUT_FD], frame[COMMAND : COMMAND + 3], clock_ns(words))
    if result == HANDED_OVER:
        return False
    if mask != 0 or int(frame[CLIP]) & ~CLIP_YIELD != 0:
        words[CLIPPED] += 1
    if result != SENT:
        words[SUPERSEDED] += 1
        return True
    now = clock_ns(words)
    if now - due_ns > words[LATE_LIMIT_NS] and words[LATE_NS] == 0:
        words[LATE_NS] = now
    count_duration(m.timing.latency, now - due_ns, k)
    words[COMMANDS] += 1
    return True


@kernel
def publish(m: Memory, frame: NDArray[np.float64]) -> None:
    """Do what ``Micron.publish`` does with a frame."""
    sinks = m.sinks
    if len(sinks.live_words) > 0:
        live_put(sinks.live_words, sinks.live_rows, frame)
        release_fence()  # pyright: ignore[reportCallIssue]
        live_announce(sinks.live_words)
    if len(sinks.ring.words) > 0 and ring_put(sinks.ring, frame):
        release_fence()  # pyright: ignore[reportCallIssue]
        ring_announce(sinks.ring.words)
    sinks.page_frame[:] = frame


@kernel
def is_verify_due(m: Memory, k: int, due_ns: int) -> bool:
    """Decide, as ``Scheduler`` does, whether the output is read back in tick ``k``; a read-back that would end too late
    is deferred."""
    words, tasks = m.words, m.timing.tasks
    if words[VERIFY_DIVIDER] == 0:
        return False
    is_due = k % words[VERIFY_DIVIDER] == words[VERIFY_PHASE]
    if words[VERIFY_WAITED] == 0 and not is_due:
        return False
    if is_due and words[VERIFY_WAITED] > 0:
        tasks[SKIPPED, VERIFY] += 1
    is_late = clock_ns(words) + tasks[BUDGET_NS, VERIFY] > due_ns + words[VERIFY_END_NS]
    if is_late and words[VERIFY_WAITED] < words[VERIFY_PATIENCE]:
        words[VERIFY_WAITED] += 1
        tasks[PUT_OFF, VERIFY] += 1
        return False
    words[VERIFY_WAITED] = 0
    return True


@kernel
def count_task(timing: Timing, stage: int, started_ns: int, ended_ns: int, due_ns: int, k: int) -> None:
    """Count one run of a task, as ``Scheduler`` does."""
    tasks = timing.tasks
    tasks[RUNS, stage] += 1
    if ended_ns - started_ns > tasks[BUDGET_NS, stage]:
        tasks[OVERRUNS, stage] += 1
    if ended_ns - due_ns > tasks[DEADLINE_NS, stage]:
        tasks[SLIPS, stage] += 1
    count_duration(timing.durations[stage], ended_ns - started_ns, k)
    count_duration(timing.lateness[stage], started_ns - due_ns, k)


@kernel
def hand_over(words: Words, row: int, stage: int, found: int) -> int:
    words[DONE_ROW], words[DONE_STAGE], words[FOUND] = row, stage, found
    return REST


@inlined_kernel
def run_block(m: Memory) -> int:
    """Run the ticks of the block, the newest in full and the others as far as the filters need them. Return GO when all
    is done, else REST."""
    words, timing, frame = m.words, m.timing, m.step[0].frame
    n, k0 = words[BLOCK_N], words[BLOCK_SEQ] - words[SEQ_OF_TICK0]
    for row in range(n):
        k, due_ns, newest = k0 + row, words[BLOCK_T0_NS] + row * words[DT_NS], row == n - 1
        began_ns = clock_ns(words)
        if not sense(m, frame, row, k, due_ns):
            return hand_over(words, row, SENSE, 0)
        sensed_ns = clock_ns(words)
        found = estimate(m, frame, k, newest)
        if found > 0:
            return hand_over(words, row, ESTIMATE, found)
        estimated_ns = clock_ns(words)
        if newest and not actuate(m, frame, k, due_ns):
            return hand_over(words, row, ACTUATE, 0)
        actuated_ns = clock_ns(words)
        publish(m, frame)
        published_ns = learned_ns = clock_ns(words)
        if newest:  # for the others the step of the next row does it
            learn_after_step(m.step)
            learned_ns = clock_ns(words)
        ended_ns = learned_ns
        if newest and is_verify_due(m, k, due_ns):
            if not verify(m.output, words[OUTPUT_FD]):
                return hand_over(words, row, VERIFY, 0)
            ended_ns = clock_ns(words)
            count_task(timing, VERIFY, learned_ns, ended_ns, due_ns, k)
        count_task(timing, SENSE, began_ns, sensed_ns, due_ns, k)
        count_task(timing, ESTIMATE, sensed_ns, estimated_ns + learned_ns - published_ns, due_ns, k)
        if newest:
            count_task(timing, ACTUATE, estimated_ns, actuated_ns, due_ns, k)
        count_task(timing, PUBLISH, actuated_ns, published_ns, due_ns, k)
        count_duration(timing.tick_duration, ended_ns - began_ns, k)
        count_duration(timing.tick_lateness, began_ns - due_ns, k)
    return GO


@kernel
def is_ordinary(words: Words) -> bool:
    """Return True if Python need not judge the block: nothing is lost or shifted, it goes on from the last one, the run
    does not end in it, and it is not so late that a finding follows."""
    n = words[BLOCK_N]
    k0 = words[BLOCK_SEQ] - words[SEQ_OF_TICK0]
    newest_ns = words[BLOCK_T0_NS] + (n - 1) * words[DT_NS]
    return (
        words[BLOCK_LOST] == 0
        and words[BLOCK_SHIFTED] == 0
        and k0 == words[LAST_K] + 1
        and newest_ns < words[END_NS]
        and n * words[DT_NS] <= words[STALLED_NS]
    )


@kernel
def count_skipped(m: Memory, n: int) -> None:
    """Count what the older ticks of a block of ``n`` passed over."""
    words, skipped = m.words, m.timing.tasks[SKIPPED]
    skipped[ACTUATE] += n - 1
    if words[VERIFY_DIVIDER] > 0:
        for k in range(words[LAST_K] + 1, words[LAST_K] + n):
            if k % words[VERIFY_DIVIDER] == words[VERIFY_PHASE]:
                skipped[VERIFY] += 1


@kernel
def count_busy(words: Words) -> None:
    """Count the scans of a block but for the newest that came before this thread waited for them. The others came, or
    were given to this thread by the kernel, together with a newer one."""
    for row in range(words[BLOCK_N] - 1):
        if words[BLOCK_T0_NS] + row * words[DT_NS] + words[ARRIVAL_NS] < words[WAITS_SINCE_NS]:
            words[BUSY] += 1


@inlined_kernel
def take_block(m: Memory) -> int:
    """Run the block that was decoded, and count it. Return GO, GAP, or why Python must go on."""
    words = m.words
    n, awake_ns = words[BLOCK_N], clock_ns(words)
    if not is_ordinary(words) or words[ORDER] != GO:
        return SCANS
    if n > 1 and words[SCANS_LATE_NS] == 0:
        words[SCANS_LATE_NS] = awake_ns
    count_busy(words)
    result = run_block(m)
    if result != GO:
        return result
    count_skipped(m, n)
    words[RECEIVED] += n
    words[TICKS] += 1
    words[CAUGHT_UP] += n - 1
    words[LAST_K] += n
    words[LAST_DUE_NS] = words[BLOCK_T0_NS] + (n - 1) * words[DT_NS]
    return note_gap(words, awake_ns + words[PERIOD_NS])


@kernel
def note_gap(words: Words, due_ns: int) -> int:
    """Return GAP if this thread was to be awake at ``due_ns`` and was not for the time that ``HostGaps`` counts."""
    now = clock_ns(words)
    if now - due_ns < words[STALE_NS]:
        return GO
    words[GAP_DUE_NS], words[GAP_NOW_NS] = due_ns, now
    return GAP


@kernel
def ramp_alone(m: Memory) -> None:
    """Take the outputs to neutral, a step a millisecond, without Python."""
    words = m.words
    for _ in range(RAMP_LIMIT):
        if step_ramp(m.output, words[OUTPUT_FD], clock_ns(words)):
            break
        if words[FIXED_NS] == REAL_TIME:
            sleep_until_ns(now_ns() + 1_000_000)
        else:
            words[FIXED_NS] += 1_000_000


@kernel
def note_arrival(words: Words, now_ns: int) -> None:
    """Follow the median of the time from the newest scan of a block to its arrival."""
    late_ns = now_ns - (words[BLOCK_T0_NS] + (words[BLOCK_N] - 1) * words[DT_NS])
    words[ARRIVAL_NS] += ARRIVAL_STEP_NS if late_ns > words[ARRIVAL_NS] else -ARRIVAL_STEP_NS


@kernel
def wait_awake(words: Words, polls: Words) -> int:
    """Sleep until ``SPIN_NS`` before the next scan is expected, and wait awake until ``SPIN_NS`` after that. Return
    what ``wait_fds`` does."""
    expected_ns = words[LAST_DUE_NS] + max(1, words[BLOCK_N]) * words[DT_NS] + words[ARRIVAL_NS]
    ready = wait_fds(polls, min(expected_ns - words[SPIN_NS], words[SILENT_AT_NS]))
    if ready != 0:
        return ready
    began_ns = now = now_ns()
    end_ns = min(expected_ns + words[SPIN_NS], words[SILENT_AT_NS])
    while ready == 0 and now < end_ns:
        ready = wait_fds(polls, 0)
        now = now_ns()
    words[SPUN_NS] += now - began_ns
    return ready


@thread_kernel
def serve(m: Memory) -> int:
    """Run until Python is needed. Return why."""
    words, stream = m.words, m.stream
    polls = np.zeros(2, np.int64)
    while True:
        if words[ORDER] != GO:
            return CALLED
        if is_stuck(m.output):
            return STUCK
        if words[READS_LEFT] == 0:
            return SPENT
        words[READS_LEFT] -= 1
        now = clock_ns(words)
        if now - words[BEAT_NS] > words[BEAT_LIMIT_NS]:
            ramp_alone(m)
            return DEAF
        if words[SILENT_OF_NS] != words[LAST_DUE_NS]:  # a wait begins; bytes without a scan do not prolong it
            words[SILENT_AT_NS] = silent_at(words[LAST_DUE_NS], words[STALE_NS], now)
            words[SILENT_OF_NS] = words[LAST_DUE_NS]
            words[WAITS_SINCE_NS] = now
        polls[0], polls[1] = poll_word(words[DAQ_FD], POLLIN), poll_word(words[WAKE_FD], POLLIN)
        ready = 0
        if words[SPIN_NS] > 0 and words[FIXED_NS] == REAL_TIME:
            ready = wait_awake(words, polls)
        if ready == 0:
            ready = wait_fds(polls, words[SILENT_AT_NS] if words[FIXED_NS] == REAL_TIME else 0)
        now = clock_ns(words)
        if ready < 0:
            return READ_FAILED
        if is_ready(polls[1]):
            return CALLED
        if note_gap(words, words[SILENT_AT_NS]) == GAP:
            return GAP
        if ready == 0:
            if now + ROUNDING_NS >= words[SILENT_AT_NS]:
                return SILENT
            continue
        end = stream[0].end
        if end == len(m.buffer):
            return READ_FAILED
        n = read_fd(words[DAQ_FD], m.buffer, end, len(m.buffer))
        if n == -EAGAIN:
            continue
        if n <= 0:
            return READ_FAILED
        words[VERDICT] = accept(stream, m.buffer, n, clock_ns(words))
        if words[VERDICT] == WAIT:
            continue
        if words[VERDICT] != READY:
            return STREAM
        got, t0_ns, seq0, lost, shifted = decode(stream, m.buffer, m.rows)
        words[BLOCK_N], words[BLOCK_T0_NS], words[BLOCK_SEQ] = got, t0_ns, seq0
        words[BLOCK_LOST], words[BLOCK_SHIFTED] = lost, shifted
        note_arrival(words, clock_ns(words))
        result = take_block(m)
        if result != GO:
            return result
