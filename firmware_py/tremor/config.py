"""What the tremor stage needs to know: [firmware.tremor] of the bench."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from hal.bench import validate_table

Positive = Annotated[float, Field(gt=0.0)]


class KalmanConfig(BaseModel):
    """Tremor as a sum of narrow-band oscillators, sensor noise and drift, all seen through the RC filter.

    The gain depends only on ratios, so ``tremor_rms_m`` is the size the filter is best at, not a limit.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    frequencies_hz: tuple[Positive, ...] = (8.5, 9.2, 10.0, 10.8, 11.5)
    bandwidth_hz: Positive = 0.8
    tremor_rms_m: Positive = 14e-6
    sensor_noise_m_s2_rtHz: Positive = 1.4e-3  # at the tip; below the true 2e-3: measured best in 8-12 Hz
    drift_m_s2: Positive = 0.02  # rms of what is left of gravity and bias
    drift_s: Positive = 3.0
    reading_noise_m_s2: Positive = 0.8e-3  # quantisation, after the RC filter


class WflcConfig(BaseModel):
    """Weighted-frequency Fourier linear combiner and the combiner that trails it (000, 5.2).

    Gains belong to a signal of unit power: the input is normalised by its own (ERRATA 56).
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    start_hz: Positive = 10.0
    low_hz: Positive = 7.0
    high_hz: Positive = 13.0
    frequency_gain: Positive = 1.0e-5
    weight_gain: Positive = 0.012
    trailing_gain: Positive = 0.03
    bias_gain: Positive = 0.003
    leakage: Annotated[float, Field(ge=0.0, lt=0.1)] = 1e-4
    power_s: Positive = 1.0
    ripple_dB: Positive = 1.0
    attenuation_dB: Positive = 40.0


class TremorConfig(BaseModel):
    """Estimator, its horizon and when it counts as settled."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    tick_hz: Positive = 1000.0
    method: Literal["kalman", "wflc_flc"] = "kalman"
    # from the instant a scan is taken to the middle of the interval in which its command moves the tip
    loop_delay_s: Annotated[float, Field(ge=0.0, le=0.05)] = 0.0021  # tuned against the emulated tip, one seed
    filter_cutoff_rad_s: Positive = 1.0 / (32_000.0 * 0.33e-6)
    settle_s: Annotated[float, Field(ge=0.0, le=10.0)] = 0.7
    smoothing_s: Positive = 0.5
    floor_m: Positive = 0.3e-6
    max_gap_ticks: Annotated[int, Field(ge=1, le=1000)] = 50
    kalman: KalmanConfig = KalmanConfig()
    wflc: WflcConfig = WflcConfig()

    @model_validator(mode="after")
    def _check(self) -> TremorConfig:
        if not self.wflc.low_hz < self.wflc.start_hz < self.wflc.high_hz < 0.5 * self.tick_hz:
            raise ValueError("wflc: low_hz < start_hz < high_hz < tick_hz / 2 is needed")
        return self

    @classmethod
    def from_dict(cls, table: Mapping[str, Any], where: str = "[firmware.tremor]") -> TremorConfig:
        """Checked configuration; ``BenchError`` names the wrong key."""
        return validate_table(cls, table, where)
