"""The second instrument: samples of inertial sensors turn into attitude and field of view.

A tick of the host clock reads and fuses each sensor that is due (the card gives all that has arrived), steers,
publishes, and watches. The view is what moves: in a hold it stands still, and it is safe when the run ends.
"""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.polling import poll_divider
from drivers.polls import Polls
from firmware_py.endoscope.config import EndoscopeConfig, choose_steering
from firmware_py.endoscope.control import INACTIVE
from firmware_py.endoscope.frame import ACCEL, CARD_STATUS, FUSED, GYRO, HELD, LAYOUT, TEMPERATURE, TICK, TIME
from firmware_py.endoscope.report import experiment
from firmware_py.endoscope.steering import Steering
from firmware_py.endoscope.targets import GameState
from firmware_py.endoscope.wiring import Sensor, Sensors
from firmware_py.run.context import Run
from firmware_py.run.findings import Finding, classify_sensor_error
from firmware_py.run.orders import PageOrders
from firmware_py.run.safety import SelfTestLimits
from firmware_py.run.tasks import EVERY_TICK, TaskRow
from firmware_py.scheduler.histogram import DurationHistogram
from firmware_py.scheduler.task import TickInfo
from firmware_py.scheduler.ticker import HostTicker, Ticks
from firmware_py.sensing.fusion import Fusion, angles_deg
from hal.errors import HalError
from hal.types import Status

IMU_US, CARD_US = 900.0, 400.0
"""Longest time for a reading of a chip, and of all that a card has sent."""
DEADLINE_TICKS = 5.0
MOST_AT_ONCE = 32
HISTORY, HISTORY_NS = 18_000, 100_000_000
SILENT_PERIODS = 5
"""Periods without a sample after which the view does not move again yet."""


@dataclass
class Track:
    """Tracks one sensor. ``used`` samples went into its attitude, ``seen`` is the number of the newest sample."""

    sensor: Sensor
    fusion: Fusion
    seen: int = -1
    received: int = 0
    used: int = 0
    failed: int = 0
    """Readings that ended in an error."""
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
        """Read once. Return None without a new sample, else whether it goes into the attitude (the card's spike filter
        may hold it back). Raises ``HalError``."""
        status = self.sensor.read()
        sample = self.sensor.sample
        if sample.seq == self.seen:
            return None
        self.seen = sample.seq
        self.received += 1
        self.t_ns = sample.t_ns
        is_used = not status & Status.STALE
        self.used += is_used
        return is_used

    def fuse(self) -> None:
        """Put the sample that was taken into the attitude."""
        sample = self.sensor.sample
        dt_s = None if self.last_used_ns < 0 else (sample.t_ns - self.last_used_ns) * 1e-9
        self.last_used_ns = sample.t_ns
        self.fusion.step(sample.gyro_rad_s, sample.accel_mps2, dt_s=dt_s)

    def keep(self) -> None:
        """Keep the attitude after a sample that was used, ten times a second."""
        if self.fusion.aligned and (not self.history or self.t_ns - self.history[-1][0] >= HISTORY_NS):
            w, x, y, z = (float(v) for v in self.fusion.quaternion)
            self.history.append((self.t_ns, w, x, y, z))


class Endoscope:
    """Runs opened sensors in ``run``. ``on_state`` is told the state of the view after each sample of the steering
    sensor; with ``until_done`` the run ends when the last target is reached."""

    def __init__(
        self,
        sensors: Sensors,
        config: EndoscopeConfig,
        run: Run,
        on_state: Callable[[GameState, int], None] | None = None,
        *,
        until_done: bool = False,
    ) -> None:
        self.config = config
        self.run = run
        self.self_test: SelfTestLimits | None = None
        self.budget_us: dict[str, float] = config.budget_us
        self.closers: Sequence[Callable[[], object]] = (sensors.close,)
        steered_by = sensors.by_name[choose_steering(config, sensors.kinds())]
        self._first_seq = 0
        self.view = Steering(config, steered_by.rate_hz)
        self.tracks = {
            name: Track(sensor, self.view.fusion if sensor is steered_by else Fusion(config.fusion, sensor.rate_hz))
            for name, sensor in sensors.by_name.items()
        }
        self.steering = self.tracks[steered_by.name]
        self._sensors, self._on_state, self._until_done = sensors, on_state, until_done
        self._orders = PageOrders(run, lambda order, now_ns: None)
        self._rows: list[NDArray[np.float64]] = []
        self._ticker = HostTicker(run.clock, run.period_ns, 0)
        self.tasks: Sequence[TaskRow] = self._task_rows()

    def _task_rows(self) -> list[TaskRow]:
        rows: list[TaskRow] = []
        tick_hz = round(1e9 / self.run.period_ns)
        late = DEADLINE_TICKS
        for order, (name, track) in enumerate(self.tracks.items()):
            # the card's lines come when they come: asked twice as often as they are due
            per_sample, budget = (2, CARD_US) if track.sensor.card is not None else (1, IMU_US)
            rate = Polls(poll_divider(per_sample * track.sensor.rate_hz, tick_hz))
            phase = order % rate.divider
            rows.append(TaskRow(name, self._reader(track), rate, budget, phase=phase, deadline_ticks=late))
        rows.append(TaskRow("publish", self.publish, EVERY_TICK, 50.0, deadline_ticks=late))
        rows.append(TaskRow("watch", self.watch, Polls(10), 50.0, phase=3, deadline_ticks=late))
        return rows

    # -- what the loop asks -------------------------------------------------------------------------------

    def prepare(self) -> None:
        pass

    def running(self) -> AbstractContextManager[object]:
        return contextlib.nullcontext()

    def start(self) -> None:
        """Start the sensors. The run's time begins when what a card sent before is forgotten."""
        run = self.run
        self._sensors.start()
        for track in self.tracks.values():
            track.forget()
        self._first_seq = self.steering.seen + 1
        run.started_ns = self.steering.t_ns = run.clock.now_ns()
        self._ticker = HostTicker(run.clock, run.period_ns, run.started_ns)

    def wait(self) -> Ticks | None:
        return self._ticker.wait()

    def poll(self) -> Ticks | None:
        return None

    def inspect_ticks(self, ticks: Ticks) -> None:
        if self._until_done and self.view.game.done:
            self.run.incidents.report(Finding.TARGETS_REACHED)

    def rest(self) -> None:
        pass

    def repair(self) -> None:
        pass

    def waiting_for(self) -> list[str]:
        track = self.steering
        silent_ns = self.run.clock.now_ns() - track.t_ns
        if silent_ns > SILENT_PERIODS * 1e9 / track.sensor.rate_hz:
            return [f"samples of {track.sensor.name}"]
        return []

    # -- tasks --------------------------------------------------------------------------------------------

    def _reader(self, track: Track) -> Callable[[TickInfo], object]:
        """Return the task that reads all that has arrived for a card, the newest of a chip."""
        most = MOST_AT_ONCE if track.sensor.card is not None else 1

        def read(info: TickInfo) -> None:
            try:
                for _ in range(most):
                    is_used = track.take()
                    if is_used is None:
                        return
                    if track is self.steering:
                        self._steer(info, is_used)
                    elif is_used:
                        track.fuse()
                    if is_used:
                        track.keep()
            except HalError as error:
                self._report_error(track, error)

        return read

    def _report_error(self, track: Track, error: HalError) -> None:
        """Hold the view, or end the run, for an error of the steering sensor; notice that of another one."""
        track.failed += 1
        if track is self.steering:
            self.run.incidents.report_error(classify_sensor_error(error), track.sensor.name, error)
        else:
            self.run.incidents.notice(f"{track.sensor.name} does not answer")

    def _steer(self, info: TickInfo, is_used: bool) -> None:
        run, track = self.run, self.steering
        sample, card = track.sensor.sample, track.sensor.card
        frame = LAYOUT.new_frame()
        frame[TICK], frame[TIME] = sample.seq - self._first_seq, (track.t_ns - run.started_ns) * 1e-9
        frame[ACCEL : ACCEL + 3], frame[GYRO : GYRO + 3] = sample.accel_mps2, sample.gyro_rad_s
        frame[TEMPERATURE] = sample.temperature_C
        frame[CARD_STATUS] = card.card_status if card is not None else INACTIVE
        frame[FUSED], frame[HELD] = is_used, run.supervisor.is_holding
        state = self.view.step(frame)
        run.counts.latency.add(max(0, run.clock.now_ns() - track.t_ns), info.k)
        self._rows.append(frame)
        if self._on_state is not None:
            self._on_state(state, track.t_ns)

    def publish(self, info: TickInfo) -> None:
        """Publish and record the frames of this tick."""
        for frame in self._rows:
            self.run.publish(frame)
        self._rows.clear()

    def watch(self, info: TickInfo) -> None:
        """Obey the page's orders, and hold the view when the steering sensor is silent."""
        self._orders.handle_orders()
        limit_ms = self.config.silent_ms
        if self.run.clock.now_ns() - self.steering.t_ns > limit_ms * 1e6:
            self.run.incidents.report(Finding.SAMPLES_MISSING, device=self.steering.sensor.name, limit_ms=limit_ms)

    # -- what people see ----------------------------------------------------------------------------------

    def histograms(self) -> dict[str, DurationHistogram]:
        return {"arrival to view": self.run.counts.latency}

    def numbers(self) -> dict[str, object]:
        state = self.view.game.state()
        return {
            "mode": ("inactive", "move", "zoom")[self.view.status],
            "angles_deg": list(angles_deg(self.view.fusion.quaternion)),
            "view": [state.view.x, state.view.y, state.view.size],
            "reached": state.reached,
            "lost": sum(track.sensor.lost for track in self.tracks.values()),
        }

    def report(self) -> dict[str, Any]:
        run, trip, game = self.run, self.run.supervisor.trip_cause, self.view.game
        ran_s = ((trip.t_ns if trip is not None else run.started_ns) - run.started_ns) * 1e-9
        state = game.state()
        sensors = {
            name: {
                "rate_hz": track.sensor.rate_hz,
                "expected": round(ran_s * track.sensor.rate_hz),
                "received": track.received,
                "used": track.used,
                "failed": track.failed,
                "lost": track.sensor.lost,
                "masked": track.sensor.masked,
                "bad_frames": track.sensor.bad_frames,
            }
            for name, track in self.tracks.items()
        }
        return {
            "instrument": "endoscope",
            "ran_s": ran_s,
            "steered_by": self.steering.sensor.name,
            "latency": {"arrival_to_view_us": run.counts.latency.distribution().as_dict()},
            "sensors": sensors,
            "samples": {key: sum(s[key] for s in sensors.values()) for key in ("expected", "received", "lost")},
            "fusion": self.config.fusion.model_dump(),
            "attitudes": {name: [list(row) for row in track.history] for name, track in self.tracks.items()},
            "view": {"status": state.status, "x": state.view.x, "y": state.view.y, "size": state.view.size},
            "experiment": experiment(game),
        }
