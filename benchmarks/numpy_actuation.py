"""The actuation of the step in plain numpy: the other half of ``benchmarks.numpy_step``, under the same rules."""

from __future__ import annotations

from typing import Any

import numpy as np

from firmware_py.frame import LAYOUT
from hal.arrays import Array

AT = {column.name: column.start if column.size == 1 else column.span for column in LAYOUT}


class NumpyActuation:
    """From the tremor ahead to volts, on the frame and the stage's records: ``state`` and ``params``."""

    def __init__(self, frame: Array, state: Any, params: Any) -> None:
        self.frame, self.a, self.ap = frame, state, params

    def step(self) -> None:
        f, a, p = self.frame, self.a, self.ap
        ahead = f[AT["tremor_ahead"]]
        trusted = f[AT["confidence"]] >= p.min_confidence
        a.on[:] = np.clip(a.on + np.where(trusted, p.ramp_step, -p.ramp_step), 0.0, 1.0)
        tip = p.mounting @ (-p.gain * a.on * ahead)
        f[AT["desired_tip"]] = tip
        stroke = self.strokes(tip, a.tilt)
        core = self.strokes(p.mounting @ (-p.gain * a.on * f[AT["tremor_core"]]), a.yielding.tilt)
        self.watch_yielding(stroke, core)
        f[AT["stroke"]] = stroke
        a.strokes[:, 1:] = a.strokes[:, :-1].copy()
        a.strokes[:, 0] = stroke
        target = (a.strokes * p.taps).sum(axis=1)
        k = p.stacks.view(np.recarray)
        rate = np.abs(target - a.target)[:, None] * p.tick_hz
        slope = k.slope + k.slope_per_rate * np.minimum(np.maximum(rate, k.rate_low[:, None]), k.rate_high)
        slope = np.maximum(slope, k.least_slope[:, None])
        # inverse
        share = (1.0 - k.creep_keep) * k.creep_share
        rest = p.neutral_stroke + target + (share * k.creep_reference[:, None] - k.creep_keep * a.creep).sum(axis=1)
        x = rest / (1.0 + share.sum(axis=1)) - k.offset
        h = self.zones(x, k.d_inverse, k.s_inverse) - k.level
        weights = np.diff(slope, axis=1, prepend=0.0)
        mapped = (weights * a.plays).sum(axis=1)[:, None] + np.zeros_like(slope)
        mapped[:, 1:] += np.cumsum(slope[:, :-1] * np.diff(a.plays, axis=1), axis=1)
        threshold = np.zeros_like(slope)
        threshold[:, 1:] = np.cumsum(slope[:, :-1] * np.diff(k.r, axis=1), axis=1)
        inverse = np.diff(1.0 / slope, axis=1, prepend=0.0)
        limited = np.maximum(h[:, None] - threshold, np.minimum(h[:, None] + threshold, mapped))
        wanted = (inverse * limited).sum(axis=1) + k.centre_V
        inside = np.clip(wanted, p.low_V, p.high_V)
        command = np.clip(inside, a.command_V - p.slew_step_V, a.command_V + p.slew_step_V)
        # forward
        drive = (command - k.centre_V)[:, None]
        a.plays[:] = np.maximum(drive - k.r, np.minimum(drive + k.r, a.plays))
        level = (weights * a.plays).sum(axis=1) + k.level
        stroke = self.zones(level, k.d, k.s) + k.offset
        a.creep[:] = k.creep_keep * a.creep + share * (stroke - k.creep_reference)[:, None]
        a.target[:], a.command_V[:] = target, command
        f[AT["command"]] = command
        f[AT["clip"]] = 2.0 * np.any(inside != wanted) + 4.0 * np.any(command != inside)

    @staticmethod
    def zones(y: Array, d: Array, s: Array) -> Array:
        return s[:, 0] * y + (s[:, 1:] * np.maximum(y[:, None] - d[:, 1:], 0.0)).sum(axis=1)

    def watch_yielding(self, stroke: Array, core: Array) -> None:
        """Peaks as the firmware remembers them; that nothing has to yield is the regular way of this yardstick."""
        p, y = self.ap, self.a.yielding
        keep, by = p.yield_keep, core - y.core_last
        y.core_last[:] = core
        y.core_power = keep * y.core_power + (1.0 - keep) * float(core @ core)
        y.core_change = keep * y.core_change + (1.0 - keep) * float(by @ by)
        ticks = np.sqrt(y.core_power / y.core_change) if y.core_change > 0.0 else 0.0
        forget = np.exp(-1.0 / (np.pi * ticks)) if ticks > 0.0 else 0.0
        y.core_over = 1.0 + forget * (max(1.0, y.core_over) - 1.0)
        rest = stroke - core
        mean = rest.mean()
        half = np.minimum(p.stroke_high, -p.stroke_low)
        y.core_peak[:] = np.maximum(p.yield_keep * y.core_peak, np.abs(core))
        room = np.maximum(0.1 * half, half - y.core_peak)
        y.side_over = max(p.yield_keep * y.side_over, float(np.max(np.abs(rest - mean) / (0.9 * room))))
        y.side_peak[:] = np.maximum(p.yield_keep * y.side_peak, np.abs(rest - mean))
        axial = np.abs(mean) / (room - np.minimum(y.side_peak, 0.9 * room))
        y.axial_over = max(p.yield_keep * y.axial_over, float(np.max(axial)))

    def strokes(self, tip: Array, warm: Array) -> Array:
        g = self.ap.geometry
        r, length = g.circle_m, g.shaft_m
        wanted = tip[:2] + g.rest_tip[:2]
        tilt = warm.copy()
        for _ in range(4):
            az = np.sqrt(1.0 - tilt @ tilt)
            k = 1.0 / (1.0 + az)
            across = np.array([0.5 * (tilt[1] ** 2 - tilt[0] ** 2), tilt[0] * tilt[1]])
            error = wanted - length * tilt - r * across * k
            if np.abs(error).sum() < 1e-12:
                break
            slope = np.array([[-tilt[0], tilt[1]], [tilt[1], tilt[0]]]) * k + np.outer(across, tilt) * (k * k / az)
            tilt = tilt + np.linalg.solve(length * np.eye(2) + r * slope, error)
        warm[:] = tilt
        flat = tilt @ tilt
        centre = tip[2] + g.rest_tip[2] + length * flat / (1.0 + np.sqrt(1.0 - flat))
        half = 0.5 * np.sqrt(3.0)
        legs = np.array([[-1.0, 0.0], [0.5, -half], [0.5, half]])
        return (centre + r * (legs @ tilt) - g.rest_m) / g.lever
