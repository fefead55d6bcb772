"""The page's part on jerk and drift: false alarms on recorded hands, detection and latency of added jerks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from firmware_py.frame import JERK
from firmware_py.tremor.detector_config import DetectorConfig
from firmware_py.tremor.detectors import Detectors
from hal.arrays import Array
from tools.research.tremor.cascade_data import integrated
from tools.research.tremor.report import Progress, table
from tools.research.tremor.signal import TremorSignal

RATE_HZ = 1000.0
TREMOR_RMS_M = 17.7e-6  # 50 um p-p
SENSOR_NOISE_M_S2_RTHZ = 2e-3
EVERY_S = 4.0
WITHIN_S = 0.4
JERKS: tuple[tuple[float, float], ...] = ((80e-6, 0.035), (160e-6, 0.035), (320e-6, 0.035), (80e-6, 0.010))
"""Peak (m) and time constant (s); 80 um and 35 ms are the emulated hand's."""


@dataclass(frozen=True)
class Found:
    """Share of added jerks that were found within ``WITHIN_S``, and when: median and 95 % (s)."""

    share: float
    median_s: float
    late_s: float


def hand_acceleration(signal: TremorSignal) -> Array:
    """Acceleration (n, 3) at the tip, 1 kHz: the angle above 7 Hz scaled to 50 um p-p, and the sensors' noise."""
    from scipy.interpolate import CubicSpline

    path = integrated(signal, 7.0)
    path *= TREMOR_RMS_M / np.sqrt(np.mean(np.max(np.var(path, axis=0))))
    spline = CubicSpline(np.arange(len(path)) / signal.rate_hz, path)
    t_s = np.arange(int((len(path) - 1) / signal.rate_hz * RATE_HZ)) / RATE_HZ
    noise = np.random.default_rng(9).standard_normal((len(t_s), path.shape[1]))
    return np.asarray(spline(t_s, 2)) + SENSOR_NOISE_M_S2_RTHZ * np.sqrt(0.5 * RATE_HZ) * noise


def jerk_acceleration(t_s: Array, start_s: float, peak_m: float, tau_s: float) -> Array:
    """Second derivative of peak (s/3)^3 exp(3 - s), s = (t - start) / tau."""
    s = np.clip((t_s - start_s) / tau_s, 0.0, 60.0)
    return peak_m / tau_s**2 * np.exp(3.0 - s) / 27.0 * (s**3 - 6.0 * s**2 + 6.0 * s)


def alarms_s(values: Array) -> Array:
    """Times at which the jerk flag goes up, with the settings of the firmware."""
    up = Detectors(DetectorConfig(), RATE_HZ).run(values) & JERK > 0
    return (np.flatnonzero(up[1:] & ~up[:-1]) + 1) / RATE_HZ


def detection(values: Array, peak_m: float, tau_s: float) -> Found:
    """Jerks in random directions every ``EVERY_S`` on ``values`` (n, 3)."""
    rng = np.random.default_rng(10)
    t_s = np.arange(len(values)) / RATE_HZ
    starts = np.arange(10.0, t_s[-1] - 2.0, EVERY_S)
    changed = values.copy()
    for start in starts:
        part = slice(int(start * RATE_HZ), int((start + 2.0) * RATE_HZ))
        direction = rng.standard_normal(3)
        direction /= np.linalg.norm(direction)
        changed[part] += jerk_acceleration(t_s[part], start, peak_m, tau_s)[:, None] * direction
    alarms = alarms_s(changed)
    late = [a[0] - start for start in starts if len(a := alarms[(alarms >= start) & (alarms < start + WITHIN_S)])]
    if not late:
        return Found(0.0, float("nan"), float("nan"))
    return Found(len(late) / len(starts), float(np.median(late)), float(np.quantile(late, 0.95)))


def section(signals: list[TremorSignal], progress: Progress) -> list[str]:
    """See ``report.SECTIONS``."""
    progress("jerk and drift")
    minutes = 0.0
    false: list[list[str]] = []
    total = 0
    first: Array | None = None
    for s in signals:
        if s.quantity != "angular rate":
            continue
        values = hand_acceleration(s)[: int(300 * RATE_HZ)]
        first = values[: int(120 * RATE_HZ)] if first is None and s.reference.windows is None else first
        count = len(alarms_s(values))
        spent = len(values) / RATE_HZ / 60.0
        minutes, total = minutes + spent, total + count
        false.append([s.name, f"{spent:.1f}", str(count)])
    assert first is not None
    lines = [
        "## Jerk and drift",
        "",
        "Acceleration of the tip as the instrument would sense it: the recorded hands above 7 Hz scaled",
        "to 50 um p-p, with the",
        "sensors' noise (2 mm/s^2/rtHz), at 1 kHz. Alarms there are called false, though these hands do",
        "click and turn over.",
        "",
        *table(["hand", "minutes", "alarms"], false),
        "",
        f"{total} alarms in {minutes:.0f} minutes: hands that reach, rest and click in turn are not",
        "stationary, and the",
        "chi-squared of a jerk is one only against a background that lasts. So the flag is counted and",
        "shown and never ends a",
        "run. On a synthetic steady hand (tremor of wandering amplitude, noise, wandering bias) there is",
        "none in ten minutes",
        "(`tests/unit/tremor/test_detectors.py`). Jerks added to two minutes of a mouse hand, direction at random:",
        "",
    ]
    rows: list[list[str]] = []
    for peak_m, tau_s in JERKS:
        found = detection(first, peak_m, tau_s)
        late = "-" if np.isnan(found.median_s) else f"{1e3 * found.median_s:.0f}, {1e3 * found.late_s:.0f}"
        rows.append([f"{1e6 * peak_m:.0f} um, {1e3 * tau_s:.0f} ms", f"{100 * found.share:.0f}", late])
    chance = 100.0 * WITHIN_S * len(alarms_s(first)) / (len(first) / RATE_HZ)
    lines += table(["jerk: peak, time constant", "found (%)", "latency: median, 95 % (ms)"], rows)
    lines += [
        "",
        f"This hand's own alarms would hit {chance:.0f} % by chance; that is in the figures.",
        "A slow jerk of 80 um is hardly above what the accelerometers' noise does between 1.8 and 6 Hz:",
        "finding it would cost",
        "false alarms. Drift: a bias of 0.2 m/s^2 is reported within 1.5 s, of 0.5 m/s^2 within 0.7 s",
        "(same test file); a",
        "drift of the hand itself, without acceleration, cannot be seen by accelerometers and is not claimed.",
    ]
    return lines
