"""Defines the sensing stage's configuration: [firmware.sensing] of the bench, and the sensor calibration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from hal.plugins import ATTITUDE, offered
from hal.validation import NotNegative, Positive, StrictTable, validate_table

Vector = tuple[float, float, float]
Pair = tuple[float, float]
Input = Annotated[int, Field(ge=0, le=7)]
Axis = Annotated[int, Field(ge=0, le=7)]
FARTHEST_M = 1.0  # nobody holds a longer instrument
LEAST_AXES, MOST_AXES = 6, 8
"""Numbers of axes: there are six unknowns, and the converter has eight inputs."""
PER_AXIS = (
    "noise_ug_per_rtHz",
    "axis_drift_m_s2",
    "bias_V",
    "scale_V_per_g",
    "bias_V_per_C",
    "scale_per_C",
    "bias_in_plane",
    "bias_out_of_plane",
    "scale_out_of_plane",
)
"""Keys with a value for each axis; absent ones are filled with the default of all."""
DEFAULT_METHOD = "error-state"
"""The built-in attitude filter; packages offer others in the group ``micron.attitude``."""
DRIFT_S = 100.0
"""Time over which a slow drift is stated."""
UNIT_AXES: tuple[Vector, ...] = (
    (1.0, 0.0, 0.0),
    (0.0, 0.0, 1.0),
    (0.0, 1.0, 0.0),
    (0.0, 0.0, 1.0),
    (1.0, 0.0, 0.0),
    (0.0, 1.0, 0.0),
)


def attitude_methods() -> tuple[str, ...]:
    """Return the names of the built-in attitude filter and of those of installed packages."""
    return (DEFAULT_METHOD, *sorted(offered(ATTITUDE)))


class SensingConfig(StrictTable):
    """Sets sensors, geometry and attitude filter. Sensor order: a1x, a1z, a2y, a2z, a3x, a3y (Ang 2004 (2.34)), then
    more.

    With seven or eight axes, ``channels``, ``positions_m`` and ``axes`` name them; supply and temperature give up
    inputs.
    """

    tick_hz: Positive = 1000.0
    lsb_V: Positive = 10.0 / 65536.0
    channels: tuple[Input, ...] = (0, 1, 2, 3, 4, 5)
    supply_channel: Input | None = 6  # None: the supply is taken as nominal
    temperature_channel: Input | None = 7  # None: the temperature is taken as the reference

    # Ang 2004 (2.54), second: d1 = 20.2, d2 = 14.3, d3 = 116.0 mm; front sensor on the tool axis
    # packages of two axes in the order of the axes, or a place for each axis
    positions_m: tuple[Vector, ...] = (
        (0.0059, -0.0143, 0.0),
        (-0.0143, 0.0059, 0.0),
        (0.0, 0.0, 0.116),
    )
    axes: tuple[Vector, ...] = UNIT_AXES
    tip_m: Vector = (0.0, 0.0, 0.155)
    gravity_m_s2: Positive = 9.80131
    noise_ug_per_rtHz: tuple[float, ...] = (110.0,) * 6
    # rms of an axis' slow drift over 100 s, beside alpha_drift_rad_s2; both keys as `micron noise` measures them
    axis_drift_m_s2: tuple[NotNegative, ...] = (0.0,) * 6
    filter_ohm: Positive = 32_000.0  # ADXL-203 output resistance with the external capacitor, Ang 2004 sec. 3.2.1.7
    filter_farad: Positive = 0.33e-6

    nominal_supply_V: Positive = 5.0
    supply_divider: Positive = 2.0
    temperature_offset_V: float = 0.5  # TMP36
    temperature_scale_V_per_C: Positive = 0.010
    reference_temperature_C: float = 25.0
    bias_V: tuple[float, ...] = (2.5,) * 6
    scale_V_per_g: tuple[float, ...] = (1.0,) * 6
    bias_V_per_C: tuple[float, ...] = (0.0,) * 6
    scale_per_C: tuple[float, ...] = (0.0,) * 6
    range_g: Positive = 1.7
    # composite model, Ang 2004 (3.4)-(3.14): which axes stand for V_y and V_z, and their polynomials without constant
    # (erratum 29) in the first reading of those axes: linear part 1 and quadratic part 1/g of the bias in g; for the
    # scale factor 1/g and 1/g^2
    in_plane: tuple[Axis, ...] = (1, 0, 3, 2, 5, 4)
    out_of_plane: tuple[Axis, ...] = (2, 2, 0, 0, 1, 1)
    bias_in_plane: tuple[Pair, ...] = ((0.0, 0.0),) * 6
    bias_out_of_plane: tuple[Pair, ...] = ((0.0, 0.0),) * 6
    scale_out_of_plane: tuple[Pair, ...] = ((0.0, 0.0),) * 6

    magnetometer_bias_V: Vector = (2.5, 2.5, 2.5)
    magnetometer_scale_V_per_uT: Vector = (0.01, 0.01, 0.01)
    magnetometer_axes: tuple[Vector, Vector, Vector] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

    # numeric: force and rate of the same instant, iterated (Ang 2004 (2.6)); analytic: centripetal part of the tick
    # before
    kinematics_method: Literal["analytic", "numeric"] = "analytic"
    # analytic: a tick whose centripetal part changes by more than a tenth of a sample's noise is solved numerically
    kinematics_guard: bool = True
    attitude_method: str = DEFAULT_METHOD
    # the slow part of the hand's velocity, rms, with its correlation time: error-state filter
    hand_velocity_m_s: Positive = 8e-5
    hand_velocity_s: Positive = 1.0
    # density of the hand's faster velocity over its variance, which is learned: one over twice a bandwidth of 5 Hz; 0:
    # that velocity is not looked for
    hand_swing_s: NotNegative = 0.1
    # middle and width of the band of tremor, which that velocity leaves out; width 0: none
    tremor_notch_hz: tuple[Positive, Annotated[float, Field(ge=0.0)]] = (9.8, 6.0)
    velocity_gate: Annotated[float, Field(ge=0.0)] = 4.0  # standard deviations; 0: no gate
    hand_acceleration_m_s2: Positive = 0.05  # rms below the tremor band: quaternion filter
    alpha_drift_rad_s2: Positive = 0.003  # rms of the slow drift of the solved angular acceleration over 100 s
    heading_noise_rad: Positive = 0.003  # per square root of a second: the surroundings' own fluctuation
    heading_disturbance_deg: Positive = 0.3  # rms of what turns the field slowly, over some seconds
    heading_tilts: bool = True  # a tilt about north is known to turn the heading that the field shows
    magnetometer_noise_uT: NotNegative = 0.0  # white, per square root of a second
    horizontal_field_uT: Positive = 20.0
    align_s: Annotated[float, Field(ge=0.02, le=10.0)] = 0.08
    attitude_start_hz: Positive = 1.0
    attitude_hz: tuple[Positive, Positive, Positive] = (0.3, 0.3, 0.5)  # about the body axes
    attitude_lowpass_hz: Positive = 1.5
    max_gap_ticks: Annotated[int, Field(ge=1, le=1000)] = 50

    @field_validator("attitude_method")
    @classmethod
    def _known(cls, method: str) -> str:
        if method in attitude_methods():
            return method
        if method in ("observer", "quaternion-kalman"):
            raise ValueError(f"'{method}' is a filter to compare with: only a source tree has it (tools/research)")
        raise ValueError(f"'{method}' is no attitude filter; there are {', '.join(attitude_methods())}")

    @model_validator(mode="before")
    @classmethod
    def _fill(cls, data: Any) -> Any:
        """Per-axis keys that are absent, for another number of axes than six."""
        table = dict(cast("Mapping[str, Any]", data)) if isinstance(data, Mapping) else {}
        channels = table.get("channels")
        if not isinstance(channels, list | tuple):
            return cast("Any", data)
        n = len(cast("Sequence[object]", channels))
        if n == LEAST_AXES or not LEAST_AXES <= n <= MOST_AXES:
            return table
        for name in PER_AXIS:
            table.setdefault(name, (cls.model_fields[name].default[0],) * n)
        for name in ("supply_channel", "temperature_channel"):
            if cls.model_fields[name].default in channels:  # an axis has that input
                table.setdefault(name, None)
        more = range(LEAST_AXES, n)
        table.setdefault("in_plane", cls.model_fields["in_plane"].default + tuple(i - 1 for i in more))
        table.setdefault("out_of_plane", cls.model_fields["out_of_plane"].default + tuple(i - 2 for i in more))
        return table

    @model_validator(mode="after")
    def _check(self) -> SensingConfig:
        n = len(self.channels)
        if not LEAST_AXES <= n <= MOST_AXES:
            raise ValueError(f"{n} channels: {LEAST_AXES} to {MOST_AXES} axes are possible")
        for name in ("axes", "in_plane", "out_of_plane", *PER_AXIS):
            if len(getattr(self, name)) != n:
                raise ValueError(f"{name} has {len(getattr(self, name))} values for {n} channels")
        if len(self.positions_m) not in (n, n / 2):
            raise ValueError(
                f"positions_m has {len(self.positions_m)} places: one for each of {n} axes, or for two each"
            )
        if any(abs(part) > FARTHEST_M for place in (*self.positions_m, self.tip_m) for part in place):
            raise ValueError(f"positions_m and tip_m are in m, at most {FARTHEST_M:g} from the origin")
        if any(i >= n for i in self.in_plane + self.out_of_plane):
            raise ValueError(f"in_plane and out_of_plane name axes 0 to {n - 1}")
        used = (*self.channels, *(c for c in (self.supply_channel, self.temperature_channel) if c is not None))
        if len(set(used)) != len(used):
            raise ValueError(f"channels {used} must be different numbers from 0 to 7")
        if any(scale == 0.0 for scale in self.scale_V_per_g + self.magnetometer_scale_V_per_uT):
            raise ValueError("a scale factor is zero")
        if any(not 0.9 < float(np.linalg.norm(axis)) < 1.1 for axis in self.axes):
            raise ValueError("axes must be unit vectors")
        if any(i in (j, k) for i, (j, k) in enumerate(zip(self.in_plane, self.out_of_plane, strict=True))):
            raise ValueError("in_plane and out_of_plane name other axes, not the axis itself")
        condition = float(np.linalg.cond(self.observation()))
        if not condition < 1e5:
            raise ValueError(f"this sensor placement is singular (condition number {condition:.3g}); move a sensor")
        return self

    @classmethod
    def from_dict(cls, table: Mapping[str, Any], where: str = "[firmware.sensing]") -> SensingConfig:
        """Return the checked configuration. Raises ``BenchError`` naming the wrong key."""
        return validate_table(cls, table, where)

    @property
    def cutoff_rad_s(self) -> float:
        """Return the corner of the RC filter behind every accelerometer axis (15.07 Hz, erratum 27)."""
        return 1.0 / (self.filter_ohm * self.filter_farad)

    def axis_positions(self) -> NDArray[np.float64]:
        """Return the position of each axis, shape (N, 3), m."""
        places = np.array(self.positions_m)
        return np.repeat(places, len(self.channels) // len(places), axis=0)

    def observation(self) -> NDArray[np.float64]:
        """Return the N x 6 matrix from (f, alpha) to readings; see ``kinematics.observation_matrix``."""
        from firmware_py.sensing.kinematics import observation_matrix

        return observation_matrix(self.axis_positions(), np.array(self.axes))
