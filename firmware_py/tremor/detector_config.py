"""Defines the jerk and drift detectors' configuration: [firmware.tremor.detectors] of the bench."""

from __future__ import annotations

from hal.validation import Positive, StrictTable


class DetectorConfig(StrictTable):
    """Sets bands and chi-squared limits for slow and brisk jerks, and the largest acceleration that is no drift.

    With three degrees of freedom the limits give less than one false alarm in ten minutes (test_detectors.py).
    """

    slow_hz: tuple[Positive, Positive] = (1.8, 6.0)
    brisk_hz: tuple[Positive, Positive] = (15.0, 45.0)
    ripple_dB: Positive = 1.0
    attenuation_dB: Positive = 30.0
    slow_chi2: Positive = 25.0
    brisk_chi2: Positive = 32.0
    background_s: Positive = 6.0
    limit: Positive = 3.0
    floor_m_s2: Positive = 1e-3
    jerk_hold_s: Positive = 0.3
    settle_s: Positive = 6.0
    drift_smoothing_s: Positive = 0.5
    drift_allowed_m_s2: Positive = 0.1
    drift_limit_m_s: Positive = 0.05
