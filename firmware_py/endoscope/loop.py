"""Runs the endoscope's loop on the host clock: one pass per tick turns samples into attitude and field of view.

A tick reads and fuses each sensor that is due (the card gives all that has arrived), steers, publishes, and watches.
"""

from __future__ import annotations

import contextlib
import signal
from collections import deque
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.polling import poll_divider
from firmware_py.endoscope.config import EndoscopeConfig
from firmware_py.endoscope.control import INACTIVE
from firmware_py.endoscope.targets import GameState, TargetGame
from firmware_py.endoscope.wiring import Sensor, Sensors
from firmware_py.scheduler.histogram import DurationHistogram
from firmware_py.scheduler.scheduler import Scheduler
from firmware_py.scheduler.task import BackgroundSpec, TaskSpec, TickInfo
from firmware_py.scheduler.ticker import HostTicker
from firmware_py.sensing.fusion import Fusion, angles_deg
from hal.contracts import Clock
from hal.errors import BenchError, HalError
from hal.types import Status

BUDGETS_US = {"imu": 900.0, "card": 400.0, "publish": 50.0, "watch": 50.0}
MOST_AT_ONCE = 32
HISTORY, HISTORY_NS = 18_000, 100_000_000
FRAME = [("tick", "1"), ("t", "s"), *((f"accel_{a}", "m/s^2") for a in "xyz"), *((f"gyro_{a}", "rad/s") for a in "xyz")]
FRAME += [("temperature", "degC"), ("status", "1"), ("used", "1"), *((f"quaternion_{a}", "1") for a in "wxyz")]
FRAME += [("psi", "deg"), ("theta", "deg"), ("view_x", "px"), ("view_y", "px"), ("view_size", "px"), ("reached", "1")]


class Recorder(Protocol):
    """Receives finished frames and events. It never blocks, and counts what it drops."""

    def push(self, row: NDArray[np.float64]) -> bool: ...
    def event(self, event: dict[str, object]) -> bool: ...


@dataclass
class Track:
    """Tracks one sensor's attitude. ``used`` samples went into it, ``seen`` is the number of the newest sample."""

    sensor: Sensor
    fusion: Fusion
    seen: int = -1
    received: int = 0
    used: int = 0
    t_ns: int = 0
    last_used_ns: int = -1
    history: deque[tuple[int, float, float, float, float]] = field(
        default_factory=lambda: deque[tuple[int, float, float, float, float]](maxlen=HISTORY)
    )
    """Time and quaternion ten times a second, the newest half hour."""

    def forget(self) -> None:
        """Discard what a card has sent since it was opened, because it does not belong to this run."""
        while self.sensor.card is not None:
            self.sensor.read()
            if self.sensor.sample.seq == self.seen:
                return
            self.seen = self.sensor.sample.seq

    def take(self) -> bool | None:
        """Read once: None without a new sample, else whether it was used (the spike filter may hold it back)."""
        status = self.sensor.read()
        sample = self.sensor.sample
        if sample.seq == self.seen:
            return None
        self.seen = sample.seq
        self.received += 1
        self.t_ns = sample.t_ns
        if status & Status.STALE:
            return False
        dt_s = None if self.last_used_ns < 0 else (sample.t_ns - self.last_used_ns) * 1e-9
        self.last_used_ns = sample.t_ns
        self.fusion.step(sample.gyro_rad_s, sample.accel_mps2, dt_s=dt_s)
        self.used += 1
        if self.fusion.aligned and (not self.history or sample.t_ns - self.history[-1][0] >= HISTORY_NS):
            q = self.fusion.quaternion
            self.history.append((sample.t_ns, float(q[0]), float(q[1]), float(q[2]), float(q[3])))
        return True


class EndoscopeLoop:
    """Runs opened sensors. ``on_state`` is told the state of the view after each sample of the steering sensor."""

    def __init__(
        self,
        sensors: Sensors,
        config: EndoscopeConfig,
        clock: Clock,
        *,
        tick_hz: int,
        recorder: Recorder | None = None,
        on_status: Callable[[dict[str, Any]], None] | None = None,
        on_state: Callable[[GameState, int], None] | None = None,
    ) -> None:
        self.config = config
        self.game = TargetGame(config.game)
        self.tracks = {name: Track(s, Fusion(config.fusion, s.rate_hz)) for name, s in sensors.by_name.items()}
        self.steering = self.tracks[_steering(config, sensors)]
        self.latency = DurationHistogram()
        self.error: HalError | None = None
        self.reason = ""
        self.normal = False
        self.ended_ns: int | None = None
        self.started_ns = 0
        self._sensors, self._clock, self._tick_hz = sensors, clock, tick_hz
        self._recorder, self._on_status, self._on_state = recorder, on_status, on_state
        self._row = np.zeros(len(FRAME))
        self._rows: list[NDArray[np.float64]] = []
        self._card_status = INACTIVE
        self._interrupted = ""
        self.scheduler = Scheduler(
            self._task_table(),
            clock,
            period_ns=1_000_000_000 // tick_hz,
            background=[BackgroundSpec("status", self._report_status, 150.0)] if on_status else [],
        )

    def _task_table(self) -> list[TaskSpec]:
        budget = {**BUDGETS_US, **self.config.budget_us}
        period_us = 1e6 / self._tick_hz
        table: list[TaskSpec] = []
        for order, (name, track) in enumerate(self.tracks.items()):
            # the card's lines come when they come: asked twice as often as they are due
            per_sample = 2 if track.sensor.card is not None else 1
            divider = poll_divider(per_sample * track.sensor.rate_hz, self._tick_hz)
            kind = "card" if track.sensor.card is not None else "imu"
            table.append(
                TaskSpec(name, self._reader(track), divider, order % divider, order, budget[kind], 5.0 * period_us)
            )
        rest = len(table)
        table.append(TaskSpec("publish", self._publish, 1, 0, rest, budget["publish"], 5.0 * period_us))
        table.append(TaskSpec("watch", self._watch, 10, 3 % 10, rest + 1, budget["watch"], 5.0 * period_us))
        return table

    # -- running ------------------------------------------------------------------------------------------

    def run(self, seconds: float, *, until_done: bool = False) -> None:
        """Measure and steer for ``seconds``, or until the last target is reached.

        A hardware error becomes ``reason`` and is kept in ``error``; anything else is raised. The view then holds.
        """
        period_ns = 1_000_000_000 // self._tick_hz
        with self._operator():
            try:
                self._sensors.start()
                for track in self.tracks.values():
                    track.forget()
                self.started_ns = self._clock.now_ns()
                self.steering.t_ns = self.started_ns
                ticker = HostTicker(self._clock, period_ns, self.started_ns)
                end_ns = self.started_ns + round(seconds * 1e9)
                while not self.reason:
                    ticks = ticker.wait()
                    if self._interrupted:
                        self._end(f"stopped by the operator ({self._interrupted})", normal=True)
                    elif ticks.due_ns >= end_ns:
                        self._end("run finished", normal=True)
                    elif until_done and self.game.done:
                        self._end("all targets reached", normal=True)
                    else:
                        self.scheduler.run(ticks)
                        self.scheduler.run_slack(ticks.due_ns + 2 * period_ns)
            except HalError as error:
                self.error = error
                self._end(f"{error}")
            finally:
                self._sensors.close()

    @contextlib.contextmanager
    def _operator(self) -> Iterator[None]:
        """SIGINT and SIGTERM end the run in order, where signals can be had (the main thread)."""

        def interrupt(number: int, _frame: object) -> None:
            self._interrupted = signal.Signals(number).name

        try:
            previous = {s: signal.signal(s, interrupt) for s in (signal.SIGINT, signal.SIGTERM)}
        except ValueError:
            previous = {}
        try:
            yield
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)

    def _end(self, reason: str, *, normal: bool = False) -> None:
        if self.reason:
            return
        self.reason, self.normal = reason, normal
        self.ended_ns = self._clock.now_ns()
        if self._recorder is not None:
            self._recorder.event({"t_ns": self.ended_ns, "event": "end", "reason": reason})

    # -- tasks --------------------------------------------------------------------------------------------

    def _reader(self, track: Track) -> Callable[[TickInfo], object]:
        """All that has arrived for a card, the newest of a chip."""
        most = MOST_AT_ONCE if track.sensor.card is not None else 1

        def read(info: TickInfo) -> None:
            for _ in range(most):
                used = track.take()
                if used is None:
                    return
                if track is self.steering:
                    self._steer(info, used)

        return read

    def _steer(self, info: TickInfo, used: bool) -> None:
        track = self.steering
        card = track.sensor.card
        status = card.card_status if card is not None else INACTIVE
        if status != INACTIVE and self._card_status == INACTIVE:
            # the start attitude is that of the activation, its heading zero (section 6.2); the click shook the sensor,
            # so the averaging begins with the next sample that the spike filter lets through
            track.fusion.restart()
            used = False
        self._card_status = status
        psi, theta, _ = angles_deg(track.fusion.quaternion)
        use = used and track.fusion.aligned
        t_s = (track.t_ns - self.started_ns) * 1e-9
        state = self.game.step_card((psi, theta), status, max(t_s, 0.0), use=use)
        self.latency.add(max(0, self._clock.now_ns() - track.t_ns), info.k)
        if self._recorder is not None:
            self._rows.append(self._frame(info, use, psi, theta, state))
        if self._on_state is not None:
            self._on_state(state, track.t_ns)

    def _frame(self, info: TickInfo, use: bool, psi: float, theta: float, state: GameState) -> NDArray[np.float64]:
        sample, view = self.steering.sensor.sample, state.view
        row = self._row.copy()
        row[0], row[1] = info.k, (self.steering.t_ns - self.started_ns) * 1e-9
        row[2:5], row[5:8], row[8] = sample.accel_mps2, sample.gyro_rad_s, sample.temperature_C
        row[9], row[10], row[11:15] = state.status, use, self.steering.fusion.quaternion
        row[15:] = (psi, theta, view.x, view.y, view.size, state.reached)
        return row

    def _publish(self, info: TickInfo) -> None:
        if self._recorder is not None:
            for row in self._rows:
                self._recorder.push(row)
            self._rows.clear()

    def _watch(self, info: TickInfo) -> None:
        silent_ns = self._clock.now_ns() - self.steering.t_ns
        if silent_ns > self.config.silent_ms * 1e6:
            name = self.steering.sensor.name
            self._end(f"{name}: no sample for {self.config.silent_ms:g} ms; the view is held. Check link and battery")

    def _report_status(self) -> Generator[bool, None, None]:
        assert self._on_status is not None
        due_ns = 0
        while True:
            if self._clock.now_ns() >= due_ns:
                due_ns = self._clock.now_ns() + 200_000_000
                self._on_status(self.status())
            yield False

    def status(self) -> dict[str, Any]:
        """Report a few numbers for display."""
        state = self.game.state()
        return {
            "t_s": (self._clock.now_ns() - self.started_ns) * 1e-9,
            "state": ("inactive", "move", "zoom")[self._card_status],
            "angles_deg": list(angles_deg(self.steering.fusion.quaternion)),
            "view": [state.view.x, state.view.y, state.view.size],
            "reached": state.reached,
            "lost": sum(track.sensor.lost for track in self.tracks.values()),
            "skipped": self.scheduler.skipped_ticks,
        }


def _steering(config: EndoscopeConfig, sensors: Sensors) -> str:
    names = list(sensors.by_name)
    if config.steered_by:
        if config.steered_by not in names:
            raise BenchError(f"[firmware.steered_by] '{config.steered_by}' is none of {', '.join(names)}")
        return config.steered_by
    return next((name for name, sensor in sensors.by_name.items() if sensor.card is not None), names[0])
