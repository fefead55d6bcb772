"""Defines the [firmware] table of a bench file: safety limits, self-test, plausibility, task budgets, calibrations."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from firmware_py.control.plausibility import PlausibilityLimits
from firmware_py.run.safety import SafetyLimits, SelfTestLimits
from hal.validation import StrictTable


class FirmwareConfig(StrictTable):
    """Holds the checked [firmware] table. The tables of the three stages are checked by ``StageConfigs``."""

    safety: SafetyLimits = SafetyLimits()
    self_test: SelfTestLimits = SelfTestLimits()
    plausibility: PlausibilityLimits = PlausibilityLimits()
    budget_us: dict[str, float] = Field(default_factory=dict[str, float])
    calibration: tuple[str, ...] = ()
    noise: str | None = None
    """Names the JSON file of ``micron noise`` from which the filters' covariances are computed."""
    sensing: dict[str, Any] = Field(default_factory=dict[str, Any])
    tremor: dict[str, Any] = Field(default_factory=dict[str, Any])
    actuation: dict[str, Any] = Field(default_factory=dict[str, Any])
