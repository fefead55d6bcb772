"""Defines the [firmware] table of a bench file: safety limits, self-test, plausibility, task budgets, calibrations."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from firmware_py.control.plausibility import PlausibilityLimits
from firmware_py.run.safety import SafetyLimits


class SelfTestLimits(BaseModel):
    """Sets how long the sensors must be good without interruption before arming, and the time limit of the self-test.

    ``watch_ms``: required time without interruption. ``limit_ms``: a self-test that takes longer trips.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    watch_ms: float = Field(default=500.0, ge=50.0, le=10_000.0)
    limit_ms: float = Field(default=3000.0, ge=100.0, le=60_000.0)


class FirmwareConfig(BaseModel):
    """Holds the checked [firmware] table. The tables of the three stages are checked by ``StageConfigs``."""

    model_config = ConfigDict(extra="forbid", frozen=True)

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
