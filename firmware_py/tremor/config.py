"""Defines the tremor stage's configuration: [firmware.tremor] of the bench."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from math import inf, sqrt
from types import MappingProxyType
from typing import Annotated, Any, Literal, cast

from pydantic import Field, field_validator, model_validator

from firmware_py.tremor.detector_config import DetectorConfig
from hal.plugins import ESTIMATORS, offered
from hal.types import STANDARD_GRAVITY
from hal.validation import NotNegative, Positive, StrictTable, validate_table

Share = Annotated[float, Field(ge=0.0, le=1.0)]
Edge = tuple[Positive, Positive]
_Row = tuple[float, float, float, float, float, float]

Method = str
"""One of ``METHODS``, or a name that an installed package offers (``firmware_py.tremor.own``)."""
METHODS: tuple[Method, ...] = ("adaptive", "wflc_flc", "flc", "wflc")
_FORMER = MappingProxyType(
    {"kalman": "kalman", "bmflc": "bmflc", "ebmflc": "bmflc", "bmflc_kalman": "bmflc", "ar_kalman": "ar"}
)
"""Methods that were built in, and the tables that had their options; ``tools/research`` offers them now."""


def all_methods() -> tuple[Method, ...]:
    """Return the names of the built-in methods, then those of installed packages."""
    return (*METHODS, *sorted(set(offered(ESTIMATORS)) - set(METHODS)))


def why_unknown(method: str) -> str:
    """Return a message that says why ``method`` names no estimator."""
    if method in _FORMER:
        return f"'{method}' is an estimator to compare with: only a source tree has it (tools/research)"
    return f"'{method}' is no estimator; there are: {', '.join(all_methods())}"


class WflcConfig(StrictTable):
    """Sets the weighted-frequency Fourier linear combiner and the combiner that trails it (Ang 2004, 5.2).

    Gains belong to a signal of unit power: the input is normalised by its own (erratum 56).
    """

    start_hz: Positive = 10.0
    low_hz: Positive = 7.0
    high_hz: Positive = 13.0
    frequency_gain: Positive = 1.0e-5
    weight_gain: Positive = 0.012
    trailing_gain: Positive = 0.03
    bias_gain: Positive = 0.003
    leakage: Annotated[float, Field(ge=0.0, lt=0.1)] = 1e-4
    power_s: Positive = 1.0
    prefilter: Literal["elliptic", "butterworth"] = "elliptic"
    prefilter_order: Annotated[int, Field(ge=1, le=3)] = 3  # of the prototype: a band-pass doubles it
    ripple_dB: Positive = 1.0
    attenuation_dB: Positive = 40.0


PRESETS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        # Below 6 Hz accelerometers know little; above the band, and at the stacks' resonance, the tip is to be still.
        "still tip": MappingProxyType(
            {
                "cancel_from_hz": (3.0, 6.0),
                "cancel_to_hz": (13.0, 16.0),
                "emphasis": 1.0,
                "relative": 15.0,
                "relative_powers": (1.3, 1.6),
                "relative_beyond": 1.0,
                "core_q": 4.0,
                "core_above": 0.3,
                "prior_s": 0.2,
                "burst_prior_s": 0.5,
                "share": 0.4,
                "quiet": 55.0,
                "shaken_hz": (600.0, 700.0),
            }
        )
    }
)
"""Settings of the adaptive method by the name that a bench gives in ``preset``. Keys beside it override them."""


class AdaptiveConfig(StrictTable):
    """Sets the causal linear filter that is learned from the hand (``firmware_py.tremor.adaptive``).

    ``preset`` names settings that are the start (``PRESETS``). ``memory_s`` is how long the hand is remembered,
    ``prior_s`` how many seconds of data the prior counts for.
    ``cancel_from_hz``, ``cancel_to_hz``: where what is cancelled fades in and out; ``core_hz``: the part of it that
    does not yield when the manipulator runs out of stroke. Two filters are learned, for a calm hand and for a burst,
    and mixed by the motion's power over ``gate_s`` (of a band around ``gate_hz``) against ``gate_ratio`` times that of
    all that is no tremor. ``share``: what an axis takes from the others. ``lever_share``: part of the
    prior hand's motion (variance) that is a turn about the quiet point; about the arm it turns as much. ``quiet``:
    above the band, sensor noise counts for so many times its power, so that the filter does not shake the tip there.
    ``shaken_hz``: lowest and highest resonance of the actuators, with ``shaken_damping``; the penalty is as much larger
    as a held command shakes them more. Empty: the penalty is flat. ``ease_s``: time constant with which a filter in use
    approaches the one that was solved last. ``relative``: the error is counted twice, relative to the hand's motion in
    all that is cancelled and, ``relative`` times, in the tremor band (a peak at ``emphasis_hz`` with ``core_q``); so a
    hand whose slow motion is larger does not get less of its tremor cancelled. The penalty above the band is then
    relative to the tremor, too. ``relative_powers``: with which powers of all motion over the tremor the tremor's error
    and the penalty count; 1 is relative, more is stricter where a hand's other motion is large. ``relative_beyond``: so
    much of the tremor's power is taken off all motion before the tremor's error is weighed. With 1 it counts by the
    other motion over the tremor: in a hand that has no other motion, both count alike. ``core_above``: errors above the
    tremor band count as the tremor's own do, by this share of a high-pass that is added to the peak; so their weight
    grows with the hand's other motion. ``relative`` 0: the error is counted in metres. ``above``: an error above
    ``above_hz`` counts so many times an error below it, in every hand.
    """

    preset: str = ""
    centres_hz: tuple[Positive, ...] = (2.2, 3.7, 5.2, 6.7, 8.1, 9.3, 10.5, 11.8, 14.0, 18.5)
    bandwidth_hz: Positive = 3.0
    slow_hz: tuple[Positive, ...] = (0.5, 2.0, 20.0)
    cancel_from_hz: Edge = (2.0, 4.0)
    cancel_to_hz: Edge = (16.0, 20.0)
    core_hz: tuple[Positive, Positive, Positive, Positive] = (5.5, 7.5, 13.0, 16.0)
    emphasis: Annotated[float, Field(ge=1.0, le=20.0)] = 4.0
    emphasis_hz: Positive = 9.8
    emphasis_q: Positive = 1.5
    relative: NotNegative = 0.0
    relative_powers: tuple[NotNegative, NotNegative] = (1.0, 1.0)
    relative_beyond: Share = 0.0
    above: Annotated[float, Field(ge=1.0, le=100.0)] = 1.0
    above_hz: Positive = 18.0
    core_q: Positive = 2.5
    core_above: NotNegative = 0.0
    block_s: Positive = 0.01
    half_width_s: Positive = 0.5
    memory_s: Positive = 15.0
    prior_s: Positive = 2.0
    burst_prior_s: Positive = 0.1
    share: Share = 0.3
    lever_share: Share = 0.5
    outlier: Positive = 16.0
    gate_hz: Positive = 6.3
    gate_q: Positive = 0.5
    gate_s: Positive = 0.05
    gate_ratio: Positive = 150.0
    quiet: Annotated[float, Field(ge=0.0, le=1e6)] = 100.0
    shaken_hz: tuple[()] | Edge = ()
    shaken_damping: Annotated[float, Field(gt=0.0, le=1.0)] = 0.04
    ease_s: Annotated[float, Field(ge=0.0, le=10.0)] = 0.1
    # the prior: a hand as it is expected
    tremor_rms_m: Positive = 15e-6
    least_rms_m: Positive = 2e-6
    tremor_hz: Positive = 10.0
    tremor_half_width_hz: Positive = 1.7
    burst_rms_m: Positive = 100e-6
    # a burst: half its power like the calm hand's tremor, half as seven recorded people move (mean spectrum of their
    # displacement, any level; without one of them it moves by 1.5 dB)
    burst_share: Share = 0.5
    burst_hz: tuple[Positive, ...] = (0.25, 0.5, 1, 2, 3, 4, 5, 6, 8, 10, 12, 14, 16, 20, 24)
    burst_dB: tuple[float, ...] = (24, 16, 8, 0, -5, -9, -11, -13, -16, -20, -24, -27, -29, -33, -38)
    voluntary_m: Positive = 300e-6
    voluntary_hz: Positive = 0.6
    unsteadiness_m: Positive = 4e-6
    sensor_noise_m_s2_rtHz: Positive = 2e-3
    reading_noise_m_s2: Positive = 0.8e-3
    drift_m_s2: Positive = 0.03
    drift_s: Positive = 3.0
    reading_noise_m: Positive = 1e-6  # of a displacement sensor, per sample

    @model_validator(mode="before")
    @classmethod
    def _start_from_preset(cls, table: Any) -> Any:
        if not isinstance(table, dict):
            return table
        given = cast("dict[str, Any]", table)
        return {**PRESETS.get(str(given.get("preset")), {}), **given}

    @field_validator("preset")
    @classmethod
    def _known(cls, preset: str) -> str:
        if preset and preset not in PRESETS:
            raise ValueError(f"'{preset}' is no preset; there are {', '.join(PRESETS)}")
        return preset

    @model_validator(mode="after")
    def _check(self) -> AdaptiveConfig:
        (a, b), (c, d) = self.cancel_from_hz, self.cancel_to_hz
        if not a < b < c < d:
            raise ValueError("adaptive: cancel_from_hz and cancel_to_hz must rise: from low to high")
        if self.above > 1.0 and self.emphasis > 1.0:
            raise ValueError("adaptive: above and emphasis both shape the one filter of errors; set one of them to 1")
        if any(low >= high for low, high in pairwise(self.core_hz)):
            raise ValueError("adaptive: core_hz must rise: from low to high")
        if self.shaken_hz and self.shaken_hz[0] > self.shaken_hz[1]:
            raise ValueError("adaptive: shaken_hz must name the lowest resonance first, then the highest")
        if len(self.burst_dB) != len(self.burst_hz) or any(low >= high for low, high in pairwise(self.burst_hz)):
            raise ValueError("adaptive: burst_hz must rise, with one value of burst_dB for each")
        return self


class LeverConfig(StrictTable):
    """Holds what the instrument knows of its own turning (``firmware_py.sensing.quiet_point``).

    Accelerometers know the acceleration of one point best; from there to the tip the noise of the angular acceleration
    counts with the arm. The adaptive method sees that part by itself and trusts it as far as this hand turns. It also
    sees the turn about the arm. That turn does not move the tip, but its noise is made by the same accelerometers: what
    the two share is noise, and the filter takes it out.
    """

    arm_m: tuple[float, float, float]
    """From the quiet point to the tip, body frame."""
    noise: tuple[_Row, _Row, _Row, _Row, _Row, _Row] | None = None
    """One-sided densities: of the tip's specific force (m/s^2), then of the angular acceleration (rad/s^2)."""
    noise_m_s2_rtHz: tuple[NotNegative, NotNegative, NotNegative] = (0.0, 0.0, 0.0)
    """In place of ``noise`` in recordings of versions that did not see the turn about the arm: of angular acceleration
    times arm, along each axis."""
    tip_noise_m_s2_rtHz: tuple[Positive, Positive, Positive] = (1.0, 1.0, 1.0)
    """The same of the tip."""
    gravity_m_s2: Positive = STANDARD_GRAVITY
    lean_from_hz: Positive = 0.3
    """Above it the attitude is the double integral of the angular acceleration, so gravity carries that noise into the
    tip's acceleration."""

    def tip_noise(self, axis: int) -> float:
        """Return the noise of the tip's acceleration along ``axis``, m/s^2/sqrt(Hz)."""
        return self.tip_noise_m_s2_rtHz[axis] if self.noise is None else sqrt(self.noise[axis][axis])


class TremorConfig(StrictTable):
    """Sets the tremor stage: estimator, prediction horizon, kind of samples, time to settle: ``[firmware.tremor]``.

    ``sees`` acceleration: samples in m/s^2 of the tip behind the RC filter of ``filter_cutoff_rad_s``. displacement:
    samples in m behind the same filter; a sensor without a filter has ``filter_cutoff_rad_s`` inf. Displacement holds
    voluntary motion, so all but the adaptive method use the band-passed samples, unless the motion is ``isolated``.
    ``loop_delay_s`` is how far ahead the tremor is predicted.
    """

    tick_hz: Positive = 1000.0
    method: Method = "adaptive"
    sees: Literal["acceleration", "displacement"] = "acceleration"
    isolated: bool = False
    # from the instant a scan is taken to the middle of the interval in which its command moves the tip
    loop_delay_s: Annotated[float, Field(ge=0.0, le=0.05)] = 0.0021  # tuned against the emulated tip, one seed
    filter_cutoff_rad_s: Annotated[float, Field(gt=0.0, le=inf)] = 1.0 / (32_000.0 * 0.33e-6)
    lever: LeverConfig | None = None
    """Derived from a bench's sensors. Without one only the acceleration of the tip is used."""
    settle_s: Annotated[float, Field(ge=0.0, le=10.0)] = 0.7
    smoothing_s: Positive = 0.5
    floor_m: Positive = 0.3e-6
    max_gap_ticks: Annotated[int, Field(ge=1, le=1000)] = 50
    wflc: WflcConfig = WflcConfig()
    adaptive: AdaptiveConfig = AdaptiveConfig()
    own: dict[str, Any] = Field(default_factory=dict[str, Any])
    """Options of a method that an installed package offers."""
    detectors: DetectorConfig = DetectorConfig()

    def __hash__(self) -> int:  # ``own`` is a dict and cannot be hashed; equality compares it
        return hash((self.tick_hz, self.loop_delay_s, self.filter_cutoff_rad_s, self.adaptive, self.lever))

    @model_validator(mode="before")
    @classmethod
    def _from_former(cls, table: Any) -> Any:
        """Read benches and recordings in which the options of a method of ``_FORMER`` have a table of their own."""
        if not isinstance(table, dict):
            return table
        given = cast("dict[str, Any]", table)
        own = given.get(_FORMER.get(str(given.get("method")), ""), {})
        kept = {key: value for key, value in given.items() if key not in _FORMER.values()}
        return {**kept, "own": own} if own else kept

    @field_validator("method")
    @classmethod
    def _known(cls, method: str) -> str:
        if method in METHODS or method in offered(ESTIMATORS):
            return method
        raise ValueError(why_unknown(method))

    @model_validator(mode="after")
    def _check(self) -> TremorConfig:
        if not self.wflc.low_hz < self.wflc.start_hz < self.wflc.high_hz < 0.5 * self.tick_hz:
            raise ValueError("wflc: low_hz < start_hz < high_hz < tick_hz / 2 is needed")
        a = self.adaptive
        if not max(a.cancel_to_hz[1], a.core_hz[-1], a.above_hz) < 0.5 * self.tick_hz:
            raise ValueError("adaptive: cancel_to_hz, core_hz and above_hz must end below tick_hz / 2")
        if self.isolated and self.sees != "displacement":
            raise ValueError("isolated: only samples of a displacement can hold tremor alone")
        return self

    @property
    def behind_prefilter(self) -> bool:
        """True if the Fourier methods fit band-passed samples."""
        return self.sees == "displacement" and not self.isolated

    @classmethod
    def from_dict(cls, table: Mapping[str, Any], where: str = "[firmware.tremor]") -> TremorConfig:
        """Return the checked configuration. Raises ``BenchError`` naming the wrong key."""
        return validate_table(cls, table, where)
