"""Defines the actuation stage's configuration: [firmware.actuation] of the bench, and the piezo calibration."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, cast

import numpy as np
from pydantic import Field, field_validator, model_validator

from hal.validation import Positive, StrictTable, validate_table

Taps = Annotated[tuple[float, ...], Field(min_length=1, max_length=16)]


class StackConfig(StrictTable):
    """Holds the modified Prandtl-Ishlinskii model of one stack, Ang 2004 (7.9): weights in um per V, thresholds in V
    and um.

    The default is a P-885.50 by its data sheet shape: 15 um at 100 V on the first way up, a small-signal slope
    of 70 % of that. ``micron calibrate piezo`` replaces it by the stack's own.
    """

    play_thresholds_V: tuple[float, ...] = (0.0, 4.0, 8.0, 12.0, 16.0, 20.0, 25.0, 31.0, 38.0, 45.0)
    play_weights_um_per_V: tuple[float, ...] = (
        0.1050, 0.0100, 0.0090, 0.0080, 0.0070, 0.0060, 0.0060, 0.0060, 0.0050, 0.0040,
    )  # fmt: skip
    dead_zone_thresholds_um: tuple[float, ...] = (0.0,)
    dead_zone_weights: tuple[float, ...] = (1.0,)
    offset_um: float = 0.0
    centre_V: float = 0.0
    """The plays see the drive less this: what a rate does to the slopes then leaves this voltage alone."""

    level_um: float = 0.0
    """Added to the plays' sum, so that every dead zone can be above zero."""

    slope_per_rate_s_per_V: tuple[float, ...] = ()
    """c_i of W_i(v) = W_i + c_i v, Ang 2004 (7.17), um/V per um/s; empty: rate-independent."""
    rate_low_um_per_s: Annotated[float, Field(ge=0.0)] = 0.0
    """Below, the slopes are those at this rate (Ang 2004, 7.5: the law is not linear for slow motion)."""
    rate_high_um_per_s: tuple[Positive, ...] = ()
    """Beyond, slope i is that at this rate (Ang 2004, Fig. 7.11; erratum 79); empty: never."""
    least_slope_um_per_V: Positive = 0.005
    """Slopes are held here when the rate would make them smaller: a slope of zero has no inverse."""

    creep_times_s: tuple[Positive, ...] = ()
    creep_shares: tuple[Annotated[float, Field(ge=0.0, lt=0.2)], ...] = ()
    """Each time constant's share of a step that follows by creep (Krejci, Kuhnen 2001); empty: none."""

    @model_validator(mode="after")
    def _check(self) -> StackConfig:
        for name, thresholds, weights in (
            ("play", self.play_thresholds_V, self.play_weights_um_per_V),
            ("dead_zone", self.dead_zone_thresholds_um, self.dead_zone_weights),
        ):
            if len(thresholds) != len(weights) or not thresholds:
                raise ValueError(f"{name}: as many thresholds as weights are needed")
            if thresholds[0] != 0.0 or np.any(np.diff(thresholds) <= 0.0):
                raise ValueError(f"{name}: thresholds must start at 0 and increase")
            # erratum 74: the inverse exists when every partial sum is positive; single weights may be negative
            if np.any(np.cumsum(weights) <= 0.0):
                raise ValueError(f"{name}: every partial sum of the weights must be positive, or there is no inverse")
        n = len(self.play_thresholds_V)
        for name, values in (
            ("slope_per_rate_s_per_V", self.slope_per_rate_s_per_V),
            ("rate_high_um_per_s", self.rate_high_um_per_s),
        ):
            if values and len(values) != n:
                raise ValueError(f"{name}: one value per play, or none")
        if len(self.creep_times_s) != len(self.creep_shares):
            raise ValueError("creep: as many times as shares are needed")
        if min(np.cumsum(self.play_weights_um_per_V)) <= self.least_slope_um_per_V:
            raise ValueError("least_slope_um_per_V must be below every partial sum of the play weights")
        return self


class ActuationConfig(StrictTable):
    """Sets the manipulator's geometry, the stacks, the limits and how compensation fades in."""

    tick_hz: Positive = 1000.0
    gain: Annotated[float, Field(ge=0.0, le=2.0)] = 1.0
    """Share of the predicted tremor that is cancelled; 1 cancels all of it."""
    ramp_s: Positive = 0.5
    """Time in which the compensation of an axis fades in once its prediction is trusted, and out when it is not."""
    min_confidence: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.1
    """Confidence of the tremor stage (0 to 1) from which the prediction of an axis is trusted."""

    ball_circle_m: Positive = 0.005  # R = r, Ang 2004 (6.11)
    shaft_m: Positive = 0.040  # ball plane to tip
    lever_gain: tuple[Positive, Positive, Positive] = (8.0, 8.0, 8.0)
    rest_heights_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the balls at neutral, against a level star
    mounting: tuple[tuple[float, float, float], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

    yield_s: Positive = 2.0
    """Time for which the peaks that make slow motion yield to tremor are remembered
    (firmware_py/actuation/yielding.py)."""
    yield_attack_s: Annotated[float, Field(ge=0.0, le=1.0)] = 0.04
    """Time constant with which the scales follow a swing that grows; until then the strokes clip it. With 0 they follow
    at once, and slow motion yields by its position alone, whose corners shake the tip above the band."""
    overdrive: Annotated[float, Field(ge=0.0, le=100.0)] = 1.0
    """Largest swing along the shaft, in strokes, to which tremor beyond the stroke is scaled. A swing that is clipped
    cancels more than one that just fits, and shakes the tip above the band with its corners. 0 clips every swing."""
    overdrive_tilts: bool = True
    """True if a tilt is scaled as well; False clips a tilt beyond the stroke."""
    overdrive_tilt: Annotated[float, Field(ge=0.0, le=100.0)] = 1.4
    """Largest tilt, in strokes. It may exceed ``overdrive``: a tilt is beyond the stroke in short swings only."""
    centring: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """Share of the way from neutral to the middle of what the strokes reach; compensation works about that point.
    Stacks shrink less from neutral than they grow, so at 0 the shorter side is all that a swing may use."""

    low_V: float = 0.0
    high_V: float = 100.0
    neutral_V: float = 50.0
    slew_V_per_s: Positive = 20_000.0
    stacks: tuple[StackConfig, StackConfig, StackConfig] = (StackConfig(), StackConfig(), StackConfig())
    feedforward: tuple[Taps, Taps, Taps] = ((1.0,), (1.0,), (1.0,))
    """Taps on the wanted stroke of each stack, newest first: inverse of its lag and resonance; one list for all or
    three. ``micron calibrate piezo`` writes them."""
    preview_s: Annotated[float, Field(ge=0.0, le=0.05)] = 0.0
    """Time from a demand to the stroke that it is for. It is part of the predictor's horizon ([firmware.tremor]
    loop_delay_s), which must reach at least this far."""

    @field_validator("lever_gain", mode="before")
    @classmethod
    def _one_for_all(cls, value: Any) -> Any:
        return (value,) * 3 if isinstance(value, int | float) else value

    @field_validator("feedforward", mode="before")
    @classmethod
    def _same_taps(cls, value: Any) -> Any:
        if not isinstance(value, list | tuple):
            return value
        taps = cast("list[Any]", value)
        return (taps,) * 3 if all(isinstance(tap, int | float) for tap in taps) else taps

    @model_validator(mode="after")
    def _check(self) -> ActuationConfig:
        for taps in self.feedforward:
            # what is not one at rest would drive every stroke too far or not far enough
            if not abs(sum(taps) - 1.0) < 1e-3:
                raise ValueError(f"feedforward: taps must sum to 1, not {sum(taps):g}")
        if not self.low_V < self.neutral_V < self.high_V:
            raise ValueError("low_V < neutral_V < high_V is needed")
        rotation = np.array(self.mounting)
        if rotation.shape != (3, 3) or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6):
            raise ValueError("mounting must be a 3 x 3 rotation: rows are the manipulator's axes in the body frame")
        return self

    @classmethod
    def from_dict(cls, table: Mapping[str, Any], where: str = "[firmware.actuation]") -> ActuationConfig:
        """Return the checked configuration. Raises ``BenchError`` naming the wrong key."""
        return validate_table(cls, table, where)
