"""The first instrument with its ticks in the compiled thread, as long as the outputs may move and nothing is odd.

``CompiledMicron`` is a ``Micron``. Self-test, arming, holds and ramps run as there. In between ``wait`` enters the
thread and comes back when the thread hands over; meanwhile a Python thread beside it runs the slow devices, the
supervision and the page. One of the two Python threads at a time touches the loop's objects (``_lock``). In virtual
time there is no thread beside: its pass follows each entry, so that both loops run the same tasks in the same ticks.
"""

from __future__ import annotations

import contextlib
import math
import os
import platform
import signal
import sys
import threading
from collections.abc import Generator
from typing import Any

import numpy as np

from drivers.daq.di4108 import Di4108
from firmware_py.compiled import memory as at
from firmware_py.compiled.memory import Memory, Sinks, Timing
from firmware_py.compiled.ports import Descriptor, Fed, lacks_descriptor
from firmware_py.compiled.sides import side_of
from firmware_py.control.config import FirmwareConfig
from firmware_py.control.instrument import LATE_PART, Micron
from firmware_py.control.stages import Stages
from firmware_py.control.wiring import Daq, Devices
from firmware_py.machine.waiting import kept_waiting_ns
from firmware_py.recording.recorder import RecorderProcess
from firmware_py.recording.ring import RowsView
from firmware_py.run.context import Run
from firmware_py.run.findings import Finding
from firmware_py.run.safety import State
from firmware_py.scheduler.histogram import DurationHistogram
from firmware_py.scheduler.task import TickInfo
from firmware_py.scheduler.ticker import Ticks, silent_at_ns
from hal.arrays import Array
from hal.clock import VirtualClock
from hal.contracts import AnalogOutput, Clock
from hal.errors import BenchError
from hal.types import ScanBlock, TimeSource

BEAT_LIMIT_MS = 100.0
"""The thread takes the outputs to neutral when Python has been silent for so long."""
AFTER_TICK_NS = 300_000
"""The pass of the Python thread comes so long after its tick was due: the compiled thread is done with it then."""
LONGEST_PAUSE_NS = 10_000_000
PASS_NS = 2_000_000
"""Shortest time between two passes: what is due in it runs in one, since a pass costs more than most tasks of it."""
SYNC_NS = 10_000_000
"""Time between two looks at what the thread has counted: the period of supervision and page."""
SWITCH_S = 0.0005
"""How long a Python thread may keep another one from running, instead of Python's 5 ms: a hand-over is not to wait."""


def reasons_against(daq: Daq, amplifier: AnalogOutput, clock: Clock, n_axes: int) -> list[str]:
    """Return why the devices of a bench cannot run compiled, each with the device's name; an empty list if they can."""
    reasons: list[str] = []
    if platform.machine() not in ("x86_64", "AMD64") or sys.platform != "linux":
        reasons.append(f"this machine is {sys.platform} on {platform.machine()}; the thread needs Linux on x86-64")
    if not isinstance(daq, Di4108):
        reasons.append(f"{daq.name}: {type(daq).__name__} has no kernels for it, only the DI-4108 has")
    elif why := lacks_descriptor(daq.port, clock):
        reasons.append(f"{daq.name}: {why}")
    side = side_of(amplifier, clock)
    why = "its driver has no kernels on bytes" if side is None else side.lacks()
    if why:
        reasons.append(f"{amplifier.name}: {why}")
    if n_axes > 6:
        reasons.append(f"{n_axes} accelerometer axes: what tells which of more than six is wrong is Python")
    return reasons


class CompiledMicron(Micron):
    """``Micron``, with its arguments, over devices for which ``reasons_against`` is empty.

    Raises ``BenchError`` for others. ``spin_us``: the thread waits awake from so long before each scan is expected
    until so long after. ``entries`` counts how often the thread was entered, ``ticks_compiled`` the ticks that it
    ran. In real time the report also has ``passed_over``, the scans without a tick of their own since the first entry
    while the outputs could move, ``passed_over_busy``, those of them that came while the thread was at work,
    ``passed_over_held``, the others since then (holds, ramps and arming, in which nothing is commanded), and
    ``kept_waiting_ms``, see ``kept_waiting_ns``."""

    def __init__(
        self, devices: Devices, stages: Stages, config: FirmwareConfig, run: Run, *, spin_us: float = 0.0
    ) -> None:
        super().__init__(devices, stages, config, run)
        assert run.output is not None
        reasons = reasons_against(devices.daq, run.output, run.clock, len(devices.sensing_table["channels"]))
        if reasons:
            raise BenchError("; ".join(reasons))
        output = side_of(run.output, run.clock)
        assert isinstance(devices.daq, Di4108)
        assert output is not None
        from firmware_py.compiled import thread  # numba

        self._thread = thread
        self._daq, self._output = devices.daq, output
        self._pass_ticks = max(1, PASS_NS // run.period_ns)
        self._is_virtual = isinstance(self.run.clock, VirtualClock)
        self.entries = self.ticks_compiled = 0
        self._done: tuple[int, int, int] | None = None
        self._lock = threading.Lock()
        self._is_inside = threading.Event()
        self._is_over = False
        self._beside_error: BaseException | None = None
        self._wake_read, self._wake_write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._words = np.zeros(at.N_WORDS, np.int64)
        self._words[at.SPIN_NS] = round(spin_us * 1e3)
        self._processors = os.sched_getaffinity(0)
        self._inside_ns = self._kept_waiting_ns = self._sync_due_ns = 0
        self._passed_over = self._passed_over_held = self._passed_over_counted = 0
        self._may_command = False
        self._counted = self._words.copy()
        self._tasks_counted = np.zeros((at.N_COUNTERS, len(at.STAGES)), np.int64)
        self._memory: Memory | None = None

    def prepare(self) -> None:
        """Gather the memory that Python and the thread share, and compile or load the thread."""
        self._memory = self._gather()
        self._thread.serve(self._memory)  # CALLED_BACK: returns at once

    def _gather(self) -> Memory:
        words, period_ns, safety = self._words, self.run.period_ns, self.run.limits
        words[at.FIXED_NS] = at.REAL_TIME
        words[at.BEAT_LIMIT_NS] = round(BEAT_LIMIT_MS * 1e6)
        words[at.PERIOD_NS], words[at.DT_NS] = period_ns, self._daq.dt_ns
        words[at.STALE_NS], words[at.STALLED_NS] = round(safety.stale_ms * 1e6), math.floor(safety.stalled_ms * 1e6)
        words[at.LATE_LIMIT_NS] = math.floor(LATE_PART * period_ns)
        words[at.WAKE_FD] = self._wake_read
        if verify := self.run.scheduler.find("verify"):
            words[at.VERIFY_DIVIDER], words[at.VERIFY_PHASE] = verify.divider, verify.phase
            words[at.VERIFY_PATIENCE] = verify.deferrable
            words[at.VERIFY_END_NS] = self.run.scheduler.latest_end_ns
        stream, buffer = self._daq.memory
        field = self._field
        volts, fresh = (field.volts, field.fresh) if field is not None else (np.zeros(3), np.zeros(1, np.int64))
        check = self._check.memory
        saved = np.zeros(4 * check.state["last"].size + 2, np.int64)
        return Memory(
            words, self.stages.memory, stream, buffer, self.scans.rows, check, saved, volts, fresh,
            self._output.memory(words[at.FIXED_NS : at.FIXED_NS + 1]), self._timing(), self._sinks(),
            np.zeros((at.NOTE_ROOM, 2), np.int64),
        )  # fmt: skip

    def _timing(self) -> Timing:
        def words(histogram: Any) -> at.Words:
            return np.frombuffer(histogram.words, np.int64)

        unused = DurationHistogram(), DurationHistogram(), 0, 0
        parts = [
            self.run.scheduler.task_memory(name) if self.run.scheduler.find(name) else unused for name in at.STAGES
        ]
        tasks = np.zeros((at.DEADLINE_NS + 1, len(at.STAGES)), np.int64)
        tasks[at.BUDGET_NS], tasks[at.DEADLINE_NS] = [p[2] for p in parts], [p[3] for p in parts]
        duration, lateness = self.run.scheduler.tick_memory
        return Timing(
            tasks, tuple(words(p[0]) for p in parts), tuple(words(p[1]) for p in parts), words(duration),
            words(lateness), words(self.run.counts.latency),
        )  # fmt: skip

    def _sinks(self) -> Sinks:
        width = len(self.frame)
        live_words, live_rows = np.zeros(0, np.int64), np.zeros((0, width))
        if self.run.live is not None:
            live_words, live_rows = self.run.live.view()
        slots = np.zeros((2, 1 + width))
        ring = RowsView(np.zeros(0, np.int64), slots.view(np.int64)[:, 0], slots[:, 1:])
        if self.run.recorder is not None:
            assert isinstance(self.run.recorder, RecorderProcess)
            ring = self.run.recorder.view()
        return Sinks(live_words, live_rows, ring, np.zeros(width))

    def report(self) -> dict[str, Any]:
        """See ``Micron.report``; says, as JSON values, what ran the ticks."""
        spin = {}
        if self._words[at.SPIN_NS]:
            share = int(self._words[at.SPUN_NS]) / max(self._inside_ns, 1)
            spin = {"spin_us": int(self._words[at.SPIN_NS]) * 1e-3, "spin_share": share}
        real = {}
        if self.entries and not self._is_virtual:
            self._count_passed_over(self._may_command)
            real = {
                "passed_over": self._passed_over,
                "passed_over_busy": int(self._words[at.BUSY]),
                "passed_over_held": self._passed_over_held,
                "kept_waiting_ms": self._kept_waiting_ns * 1e-6,
            }
        how = {"kind": "compiled", "entries": self.entries, "ticks": self.ticks_compiled, **real, **spin}
        return {**super().report(), "loop": how}

    # -- running -----------------------------------------------------------------------------------------

    @contextlib.contextmanager
    def running(self) -> Generator[None]:
        """See ``Micron.running``: the thread of the passes lives within the block."""
        with contextlib.ExitStack() as stack:
            stack.callback(self._close)
            if not self._is_virtual:
                stack.enter_context(self._python_beside())
            yield

    def _close(self) -> None:
        self._memory = None  # lets go of the rings, which their owners close
        self._output.close()
        os.close(self._wake_read)
        os.close(self._wake_write)

    @contextlib.contextmanager
    def _python_beside(self) -> Generator[None]:
        """Run the thread of the passes, let signals wake the compiled thread, and let hand-overs be quick."""
        beside = threading.Thread(target=self._run_beside, name="beside the compiled loop", daemon=True)
        interval_s = sys.getswitchinterval()
        before: int | None = None
        with contextlib.suppress(ValueError):  # not the main thread: signals are somebody else's
            before = signal.set_wakeup_fd(self._wake_write, warn_on_full_buffer=False)
        sys.setswitchinterval(SWITCH_S)
        beside.start()
        try:
            yield
        finally:
            self._is_over = True
            self._is_inside.set()
            beside.join()
            sys.setswitchinterval(interval_s)
            if before is not None:
                signal.set_wakeup_fd(before)

    def wait(self) -> Ticks | None:
        """See ``Micron.wait``: the thread runs the ticks in between; ``None`` where the loop must not wait any more."""
        self._count_passed_over(self._may_command)  # by the ticks that Python has run since the last wait
        while (place := self._place_to_enter()) is not None:
            result = self._enter(*place)
            self._count_passed_over(True)
            if result != at.SPENT:
                break
        self._may_command = self.run.supervisor.state is State.RUNNING and not self.run.scheduler.is_announced
        if self.run.supervisor.must_not_wait:  # found beside the thread: the ramp does not wait for the next scan
            return None
        return super().wait()

    def _count_passed_over(self, may_command: bool) -> None:
        """Count the scans that were passed over since the last call; ``may_command``: each could have had a command."""
        before, self._passed_over_counted = self._passed_over_counted, self.run.scheduler.passed_over
        if not self.entries:
            return
        if may_command:
            self._passed_over += self._passed_over_counted - before
        else:
            self._passed_over_held += self._passed_over_counted - before

    def _place_to_enter(self) -> tuple[int, int, int] | None:
        """Return where the thread goes on, None while Python has to run the ticks."""
        self._done = None
        is_free = (
            self.run.supervisor.state is State.RUNNING
            and not (self.manual.active or self.run.signals.interrupted or self.run.signals.rearm_asked)
            and self.scans.are_well
            and not self.run.scheduler.is_announced
            and not self.run.scheduler.is_deferred("verify")
            and self._output.is_well
        )
        return self._ticker.place if is_free else None

    def _enter(self, seq_of_tick0: int, last_k: int, last_due_ns: int) -> int:
        words, memory = self._words, self._memory
        assert memory is not None
        words[at.DAQ_FD], words[at.OUTPUT_FD] = _fd_of(self._daq.port), self._output.fileno()
        words[at.STARTED_NS] = self.run.started_ns
        words[at.END_NS] = at.NO_END if self.run.end_ns is None else self.run.end_ns
        words[at.SEQ_OF_TICK0], words[at.LAST_K], words[at.LAST_DUE_NS] = seq_of_tick0, last_k, last_due_ns
        words[at.WARNED], words[at.READS_LEFT] = self._warned, -1
        memory.sinks.page_frame[:] = self.frame
        self._output.begin()
        if self._is_virtual:
            self._feed(last_due_ns)
        else:
            self._kept_waiting_ns -= kept_waiting_ns()
        words[at.BEAT_NS] = self.run.clock.now_ns()
        words[at.ORDER] = (
            at.CALLED_BACK if self.run.signals.interrupted else at.GO
        )  # a signal may have come in the meantime
        self.entries += 1
        self._is_inside.set()
        entered_ns = self.run.clock.now_ns()
        result = self._thread.serve(memory)
        self._inside_ns += self.run.clock.now_ns() - entered_ns
        if not self._is_virtual:
            self._kept_waiting_ns += kept_waiting_ns()
        with self._lock:
            self._is_inside.clear()
            words[at.ORDER] = at.CALLED_BACK
            if self._is_virtual:
                self._output.flush()
            self._output.catch_up()
            self._take_over(result)
        if self._beside_error is not None:
            raise self._beside_error
        if self._is_virtual and result in (at.SPENT, at.GAP, at.STUCK):  # a tick may have been run
            self._pass_beside(last_k)
        return result

    def _take_over(self, result: int) -> None:
        """Bring the loop's objects to where the thread is, and prepare the next wait for why it has come back."""
        words, ticker = self._words, self._ticker
        self._sync()
        self._warned = int(words[at.WARNED])
        ticker.go_on_from(int(words[at.LAST_K]), int(words[at.LAST_DUE_NS]))
        if words[at.SILENT_OF_NS] == words[at.LAST_DUE_NS]:  # Python goes on with the same wait
            ticker.silent_at_ns = int(words[at.SILENT_AT_NS])
        if words[at.VERIFY_WAITED]:
            self.run.scheduler.defer("verify", int(words[at.VERIFY_WAITED]))
            words[at.VERIFY_WAITED] = 0
        match result:
            case at.CALLED:
                with contextlib.suppress(BlockingIOError):
                    os.read(self._wake_read, 4096)
            case at.SILENT:
                self.scans.hand_over(self._no_block)
            case at.SCANS | at.REST:
                self.scans.hand_over(self._block)
                if result == at.REST:
                    k, stage = int(words[at.LAST_K]) + 1 + int(words[at.DONE_ROW]), int(words[at.DONE_STAGE])
                    self._done = k, stage, int(words[at.FOUND])
                    self._output.take_over(stage == at.VERIFY)
                    if stage == at.VERIFY and k % words[at.VERIFY_DIVIDER] != words[at.VERIFY_PHASE]:
                        self.run.scheduler.defer("verify", int(words[at.VERIFY_PATIENCE]))
            case at.STREAM:
                self.scans.hand_over(self._failed_block)
            case at.GAP:
                self.run.host_gaps.record(int(words[at.GAP_DUE_NS]), int(words[at.GAP_NOW_NS]))
            case at.DEAF:
                silent_ms = (self.run.clock.now_ns() - int(words[at.BEAT_NS])) * 1e-6
                self.run.incidents.report(Finding.SUPERVISION_SILENT, silent_ms=silent_ms)
            case _:
                pass

    def _block(self) -> ScanBlock:
        n, t0_ns, seq, lost, shifted = (int(w) for w in self._words[at.BLOCK_N : at.BLOCK_SHIFTED + 1])
        return self._daq.block_of(n, t0_ns, seq, lost, bool(shifted))

    def _no_block(self) -> ScanBlock:
        return self._daq.block_of(0, 0, 0, 0, False)

    def _failed_block(self) -> ScanBlock:
        self._daq.obey(int(self._words[at.VERDICT]))
        return self._daq.read_scans(self.scans.rows, 0.0)

    def _sync(self) -> None:
        """Count what the thread has done since the last time."""
        words, memory, counts = self._words.copy(), self._memory, self.run.counts
        assert memory is not None
        new = words - self._counted
        self._counted = words
        if new[at.RECEIVED]:
            self.scans.note_run(int(new[at.RECEIVED]), int(words[at.LAST_DUE_NS]))
            self._daq.scans += int(new[at.RECEIVED])
        self.ticks_compiled += int(new[at.TICKS])
        counts.commands += int(new[at.COMMANDS])
        counts.superseded += int(new[at.SUPERSEDED])
        counts.clipped += int(new[at.CLIPPED])
        for place, what in ((at.LATE_NS, "commands were late"), (at.SCANS_LATE_NS, "scans came late")):
            if words[place]:
                counts.noticed.setdefault(what, int(words[place]))
        tasks = memory.timing.tasks[: at.N_COUNTERS].copy()
        each: dict[str, list[int]] = dict(zip(at.STAGES, (tasks - self._tasks_counted).T.tolist(), strict=True))
        self._tasks_counted = tasks
        self.run.scheduler.adopt(int(words[at.LAST_K]), int(new[at.TICKS]), int(new[at.CAUGHT_UP]), each)
        if words[at.PAIR_TOLD]:
            self._check.judge_pairs(-int(words[at.PAIR_TOLD]))
            self._words[at.PAIR_TOLD] = 0
        first = max(int(words[at.NOTES] - new[at.NOTES]), int(words[at.NOTES]) - at.NOTE_ROOM)
        for number in range(first, int(words[at.NOTES])):
            rising, self.run.incidents.tick = (int(w) for w in memory.notes[number % at.NOTE_ROOM])
            self._warn(rising)

    # -- beside ------------------------------------------------------------------------------------------

    def _run_beside(self) -> None:
        with contextlib.suppress(OSError, AttributeError):  # what waits for buses must not press the tick
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
            os.sched_setaffinity(0, self._processors)  # the loop may stay on one of its own
        last_k = -1
        while True:
            self._is_inside.wait()
            if self._is_over:
                return
            with self._lock:
                if self._is_inside.is_set() and self._beside_error is None:
                    try:
                        last_k = self._pass_beside(last_k)
                    except BaseException as error:
                        self._beside_error = error
                        self._call_back()
            words = self._words
            next_k = self.run.scheduler.next_beside(last_k, at.STAGES)
            next_k += -next_k % self._pass_ticks
            due_ns = int(words[at.LAST_DUE_NS]) + (next_k - int(words[at.LAST_K])) * self.run.period_ns + AFTER_TICK_NS
            now_ns = self.run.clock.now_ns()
            self.run.clock.sleep_until_ns(min(max(due_ns, now_ns + AFTER_TICK_NS), now_ns + LONGEST_PAUSE_NS))

    def _pass_beside(self, last_k: int) -> int:
        """Run what was due in the ticks after ``last_k``, and call the thread back if Python has to decide something.
        Return the newest tick."""
        words, memory = self._words, self._memory
        assert memory is not None
        words[at.BEAT_NS] = now_ns = self.run.clock.now_ns()
        if not self._is_virtual and now_ns >= self._sync_due_ns:
            self._sync()
            self._sync_due_ns = now_ns + SYNC_NS
        k, due_ns = int(words[at.LAST_K]), int(words[at.LAST_DUE_NS])
        if k == last_k:
            return k
        first = k if last_k < 0 or k - last_k > at.LONG_AGO else last_k + 1
        self.run.incidents.tick = k
        self.run.ticks = Ticks(k, 1, due_ns, self.run.period_ns, TimeSource.DEVICE_CLOCK)
        if not self._is_virtual:
            self._show(memory.sinks.page_frame)
        try:
            self.run.scheduler.run_beside(due_ns, first, k, at.STAGES, in_tick=self._is_virtual)
            # in real time no tick waits for what runs beside it
            next_ns = due_ns + self._daq.dt_ns if self._is_virtual else self.run.clock.now_ns()
            self.run.scheduler.run_slack(next_ns + self.run.period_ns)
        finally:
            self._show(self.stages.frame)
        if not self.run.supervisor.may_move or self.manual.active:
            self._call_back()
        return k

    def _show(self, frame: Array) -> None:
        """Let everything in Python that reads the frame read ``frame``: the thread is at work on its own."""
        self.frame = self._watch.frame = frame

    def _call_back(self) -> None:
        self._words[at.ORDER] = at.CALLED_BACK
        with contextlib.suppress(BlockingIOError):
            os.write(self._wake_write, b"!")

    # -- the rest of a block -----------------------------------------------------------------------------

    def _is_done(self, k: int, stage: int) -> bool:
        return self._done is not None and (k, stage) < self._done[:2]

    def sense(self, info: TickInfo) -> None:
        """See ``Micron.sense``; does what the thread has not done of a block that it handed over."""
        if not self._is_done(info.k, at.SENSE):
            super().sense(info)

    def estimate(self, info: TickInfo) -> None:
        """See ``Micron.estimate``; does what the thread has not done of a block that it handed over."""
        if self._is_done(info.k, at.ESTIMATE):
            return
        if self._done is not None and self._done[:2] == (info.k, at.ESTIMATE):
            self._judge_step(self._check.judge_pairs(self._done[2]))
        else:
            super().estimate(info)

    def actuate(self, info: TickInfo) -> None:
        """See ``Micron.actuate``; does what the thread has not done of a block that it handed over."""
        if not self._is_done(info.k, at.ACTUATE):
            super().actuate(info)

    def publish(self, info: TickInfo) -> None:
        """See ``Micron.publish``; does what the thread has not done of a block that it handed over."""
        if not self._is_done(info.k, at.PUBLISH):
            super().publish(info)

    # -- virtual time ------------------------------------------------------------------------------------

    def _feed(self, last_due_ns: int) -> None:
        """Let virtual time pass until the next bytes are there, then fix the time for one read."""
        daq = self._daq.port
        assert isinstance(daq, Fed)
        words, now_ns = self._words, self.run.clock.now_ns()
        if words[at.SILENT_OF_NS] != last_due_ns:
            words[at.SILENT_AT_NS] = silent_at_ns(last_due_ns, int(words[at.STALE_NS]), now_ns)
            words[at.SILENT_OF_NS] = last_due_ns
        silent_ns = int(words[at.SILENT_AT_NS])
        daq.feed(max(0, silent_ns - now_ns) * 1e-9)
        self._output.feed()
        words[at.FIXED_NS] = self.run.clock.now_ns()
        words[at.READS_LEFT] = 1


def _fd_of(port: object) -> int:
    assert isinstance(port, Descriptor)
    return port.fileno()
