"""Emulates the endoscope's motion tracking card (MTC) behind its scanner card: an MPU-6050, a button, a battery, ASCII
lines.

Source: Erat 2018, section 4.2 (card and packet), 6.2 (button, status), 6.3 with Fig. 6.5 (mechanical spike), with
errata nos. 112, 113, 121. A line is ``#:ax:ay:az:wx:wy:wz:temperature:status:`` CR LF, sent by the scanner card at
115200 baud each time a packet comes. Wire face: bytes. Truth face: an ``Imu``; ``press`` and ``release`` the button,
``battery_percent``; observables ``packet`` (the 15 bytes that go over the air, big-endian, errata no. 112), ``status``,
``lines``, ``skipped``.

Errata no. 113 (raw or scaled is not said): the seven numbers are the MPU-6050's own signed 16-bit counts in decimal,
those of the packet: the scanner card only "organizes a string". Factory ranges of the card: +-2 g, +-2000 dps, so
16384 LSB/g, 16.4 LSB/dps, T = count / 340 + 36.53 degC. ``scaled`` writes g, dps and degC with 4, 2 and 2 decimals.

Model limits
- The radio link takes no time and loses nothing; the scanner card drops a whole line while the one before is still
  going out (``skipped``) and when 4096 bytes wait for the host.
- The card's own spike filter is off, so that the spikes can be seen and filtered downstream: damped ringing of the
  case for 20 ms from each edge of the button; its size is ours (the figure gives none).
- ``calibrated``: the automatic offset calibration (4.2.1) has been done before power-up, perfectly, at that moment's
  temperature. Status changes on release; a long press always ends in status 2, a short one toggles.
- The contact does not bounce. The battery discharges with the mean current of 4.2.1; its level is published over the
  air each 30 minutes and never in a line; an empty battery ends transmission. Bytes from the host are ignored.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sim_devices.devices.register_map import SampleClock, signed_limited
from sim_devices.plant.body_motion import BodyMotion, MotionSource, Mount
from sim_devices.plant.imu import MPU6050_SPEC, REFERENCE_C, Imu
from sim_devices.plant.sensors import STANDARD_GRAVITY

ACCEL_LSB_PER_G, GYRO_LSB_PER_DPS = 16384.0, 16.4
BANDWIDTH_HZ = 94.0
STEP_HZ = 500.0  # the filter runs at least so fast
LONG_PRESS_NS = 500_000_000  # exactly this long is long (errata no. 121)
SPIKE_NS = 20_000_000
SPIKE_G, SPIKE_DPS, SPIKE_HZ, SPIKE_TAU_S = (0.25, 0.15, 0.9), (35.0, 25.0, 8.0), 60.0, 5e-3
BATTERY_MAH, CURRENT_MA = 220.0, 6.184
MAX_WAITING = 4096
HOUR_NS = 3_600_000_000_000


class MotionCard:
    """Emulates card and scanner card. ``baud`` paces the line, ``rate_hz`` is the card's sampling rate (100 Hz in Erat
    2018)."""

    def __init__(
        self,
        motion: MotionSource,
        *,
        baud: int = 115_200,
        rate_hz: float = 100.0,
        scaled: bool = False,
        calibrated: bool = True,
        seed: int = 1,
        name: str = "motion_card",
        mount: Mount | None = None,
        errors: float = 1.0,
        noise: float = 1.0,
        start_ns: int = 0,
        presses: Sequence[tuple[float, float]] = (),
    ) -> None:
        if not 1.0 <= rate_hz <= 1000.0:
            raise ValueError(f"rate_hz {rate_hz:g} is outside 1 to 1000 Hz, what an MPU-6050 gives with its filter on")
        self.unread = 0
        self.frozen = False
        self.corrupt_bytes = 0
        """Fault hook: so many of the next bytes arrive inverted."""
        self.pressed, self.status = False, 0
        self.packet = b""
        self.lines, self.skipped = 0, 0
        self._motion = motion
        self._scaled = scaled
        self._byte_ns = 10e9 / baud
        self._imu = Imu(MPU6050_SPEC, self._shaken, seed=seed, name=name, mount=mount, errors=errors, noise=noise)
        if calibrated:
            self._calibrate(motion(start_ns).temperature_C)
        self._start_ns, self._now_ns = start_ns, start_ns
        self._charge = 100.0
        self._edges: deque[int] = deque()
        self._presses = deque((start_ns + round(s * 1e9), start_ns + round((s + long) * 1e9)) for s, long in presses)
        self._pressed_ns = 0
        self._clock = SampleClock()
        self._steps = max(1, math.ceil(STEP_HZ / rate_hz - 1e-9))
        self._step = 0
        self._clock.run(start_ns, 1e9 / rate_hz / self._steps)
        self._sending = b""
        self._sending_ns = 0.0
        self._out = bytearray()

    def _calibrate(self, temperature_C: float) -> None:
        warm_K = temperature_C + MPU6050_SPEC.self_heating_K - REFERENCE_C
        for triad in (self._imu.accelerometer, self._imu.gyroscope):
            left = triad.unit.bias_per_K * -warm_K
            triad.unit = replace(triad.unit, bias=left)

    # ------------------------------------------------------------------ truth face

    def press(self) -> None:
        if not self.pressed:
            self.pressed, self._pressed_ns = True, self._now_ns
            self._edges.append(self._now_ns)

    def release(self) -> None:
        if self.pressed:
            self.pressed = False
            self._edges.append(self._now_ns)
            long = self._now_ns - self._pressed_ns >= LONG_PRESS_NS
            self.status = 2 if long else 0 if self.status else 1

    def _press_by_plan(self) -> None:
        """``presses`` (start s, how long s), at the sampling steps of the card."""
        if self._presses and self._now_ns >= self._presses[0][1]:
            self.release()
            self._presses.popleft()
        if self._presses and self._now_ns >= self._presses[0][0]:
            self.press()

    @property
    def battery_percent(self) -> float:
        """Return the true charge in percent; it can be set."""
        used = (self._now_ns - self._start_ns) / HOUR_NS * CURRENT_MA / BATTERY_MAH * 100.0
        return max(0.0, self._charge - used)

    @battery_percent.setter
    def battery_percent(self, percent: float) -> None:
        self._charge += percent - self.battery_percent

    # ------------------------------------------------------------------ wire face

    def receive(self, data: bytes, t_ns: int) -> None:
        """Ignore the host: the scanner card receives by radio only."""

    def take(self, max_bytes: int) -> bytes:
        data = bytes(self._out[:max_bytes])
        del self._out[:max_bytes]
        return data

    def next_event_ns(self) -> int | None:
        if self.frozen:
            return None
        due_ns = self._clock.due_ns
        if self._sending:
            end_ns = math.ceil(self._sending_ns + len(self._sending) * self._byte_ns)
            return end_ns if due_ns is None else min(end_ns, due_ns)
        return due_ns

    def advance_to(self, t_ns: int) -> None:
        for due_ns in self._clock.ticks_until(t_ns, frozen=self.frozen):
            self._now_ns = max(self._now_ns, due_ns)
            self._press_by_plan()
            self._transmit(due_ns)
            self._sample(due_ns)
        self._now_ns = max(self._now_ns, t_ns)
        if not self.frozen:
            self._transmit(t_ns)

    # ------------------------------------------------------------------ inside

    def _transmit(self, t_ns: int) -> None:
        """Bytes whose stop bit has passed are with the host."""
        n = min(len(self._sending), int((t_ns - self._sending_ns) / self._byte_ns + 1e-9))
        if n > 0:
            done, self._sending = self._sending[:n], self._sending[n:]
            self._sending_ns += n * self._byte_ns
            hurt = min(n, self.corrupt_bytes)
            self.corrupt_bytes -= hurt
            self._out += bytes(byte ^ 0xFF for byte in done[:hurt]) + done[hurt:]

    def _sample(self, t_ns: int) -> None:
        accel = self._imu.accelerometer.sample(t_ns, BANDWIDTH_HZ)
        gyro = self._imu.gyroscope.sample(t_ns, BANDWIDTH_HZ)
        self._step += 1
        if self._step < self._steps:
            return
        self._step = 0
        if self.battery_percent <= 0.0:
            return
        counts = [signed_limited(v) for v in accel / STANDARD_GRAVITY * ACCEL_LSB_PER_G]
        counts += [signed_limited(v) for v in np.degrees(gyro) * GYRO_LSB_PER_DPS]
        counts.append(signed_limited((self._imu.temperature_C(t_ns) - 36.53) * 340.0))
        self.packet = b"".join(count.to_bytes(2, "big", signed=True) for count in counts) + bytes((self.status,))
        if self._sending or self.unread + len(self._out) > MAX_WAITING:
            self.skipped += 1
            return
        self.lines += 1
        self._sending, self._sending_ns = self._line(counts), float(t_ns)

    def _line(self, counts: list[int]) -> bytes:
        fields = [str(count) for count in counts]
        if self._scaled:
            fields = [f"{count / ACCEL_LSB_PER_G:.4f}" for count in counts[:3]]
            fields += [f"{count / GYRO_LSB_PER_DPS:.2f}" for count in counts[3:6]]
            fields.append(f"{counts[6] / 340.0 + 36.53:.2f}")
        return f"#:{':'.join(fields)}:{self.status}:\r\n".encode("ascii")

    def _shaken(self, t_ns: int) -> BodyMotion:
        """Return the body's motion with the ringing of the case after each edge of the button."""
        motion = self._motion(t_ns)
        while self._edges and t_ns - self._edges[0] >= SPIKE_NS:
            self._edges.popleft()
        ringing = 0.0
        for edge_ns in self._edges:
            since_s = (t_ns - edge_ns) * 1e-9
            ringing += math.exp(-since_s / SPIKE_TAU_S) * math.cos(2.0 * math.pi * SPIKE_HZ * since_s)
        if not ringing:
            return motion
        return replace(
            motion,
            specific_force_m_s2=motion.specific_force_m_s2 + ringing * STANDARD_GRAVITY * np.array(SPIKE_G),
            rate_rad_s=motion.rate_rad_s + ringing * np.radians(SPIKE_DPS),
        )
