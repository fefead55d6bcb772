"""Defines the ``[emulation]`` table of a bench: one unit of the instrument, its hand and its room.

Every value has a default, so ``provider``, ``unit`` and ``seed`` alone describe a complete instrument. Spreads are
standard deviations from which the seed draws one physical unit: the same seed is the same unit everywhere
(bench, calibration recordings, tests). Ang 2004 is the instrument's dissertation, with its errata.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from hal.errors import BenchError
from hal.validation import describe_validation_error

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Vector = tuple[float, float, float]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class HandConfig(_Table):
    """Describes the surgeon's hand. ``sim_devices.plant.hand`` has the sources and reasons."""

    performs: Literal["work", "poses"] = "work"
    """"poses": turns the instrument through the 14 resting poses of a calibration by hand, over and over."""
    tilt_deg: float = 40.0
    """Instrument axis away from straight down."""
    azimuth_deg: float = 25.0
    """Direction of that tilt, from magnetic north toward west."""
    roll_deg: float = 15.0
    """Turn about the instrument's own axis."""

    voluntary_range_um: NotNegative = 300.0
    """Reach targets of the tip lie within +- this, per axis."""
    voluntary_angle_deg: NotNegative = 2.0
    """Attitude targets lie within +- this, per axis."""
    reach_s: tuple[Positive, Positive] = (1.2, 3.0)
    """Shortest and longest duration of one reach (minimum jerk: below 1 Hz)."""
    hold_s: tuple[NotNegative, NotNegative] = (0.3, 1.5)

    tremor_pp_um: NotNegative = 50.0
    """Typical peak to peak per axis at the tip (Ang 2004 sec. 6.1.1); rms = p-p / (2 sqrt 2)."""
    tremor_frequency_hz: Positive = 9.6
    tremor_frequency_spread_hz: NotNegative = 0.4
    """Spread of the mean frequency between people (seeds); the mean stays within 8.5 to 11.5 Hz unless the mean itself
    does not."""
    frequency_wander_hz: NotNegative = 0.4
    """Standard deviation of the slow wander of one person's frequency."""
    frequency_wander_s: Positive = 2.0
    """Correlation time (1/e) of the frequency."""
    envelope_s: Positive = 0.6
    """Correlation time (1/e) of the complex Gaussian envelope: a line of 0.78 Hz between half-power points."""
    amplitude_depth: NotNegative = 0.3
    """Standard deviation of the logarithm of the slow common gain (effort, grip)."""
    amplitude_s: Positive = 4.0
    """Correlation time (1/e) of that gain."""
    axis_correlation: Annotated[float, Field(ge=0, lt=1)] = 0.4
    rotation_share: Annotated[float, Field(ge=0, le=1)] = 0.6
    """Part of the lateral tip tremor that comes from turning about the grip."""
    grip_to_tip_mm: Positive = 90.0
    roll_tremor_mrad: NotNegative = 0.3
    """Tremor about the instrument's axis, rms."""

    drift_rms_um: NotNegative = 30.0
    drift_s: Positive = 6.0
    """Correlation time (1/e)."""
    unsteadiness_rms_um: NotNegative = 6.0
    """Broadband involuntary motion between drift and tremor."""
    unsteadiness_s: Positive = 0.4
    jerk_interval_s: Positive = 20.0
    """Mean time between myoclonic jerks."""
    jerk_um: NotNegative = 80.0
    """Typical (rms) peak of one."""

    recorded_band_hz: tuple[Positive, Positive] = (4.0, 20.0)
    """Band that is kept of a recorded hand: below it, integrated acceleration is tilt and noise."""

    @model_validator(mode="after")
    def _ordered(self) -> HandConfig:
        for name in ("reach_s", "hold_s", "recorded_band_hz"):
            low, high = getattr(self, name)
            if low > high or (name == "recorded_band_hz" and low == high):
                raise ValueError(f"{name} = [{low}, {high}]: the first value must be the smaller one")
        return self


class InstrumentConfig(_Table):
    """Holds the geometry in the body frame {B}: base of the back suite, z toward the tip (Ang 2004 (2.54), errata no.
    23).

    Only the differences d1 = 20.2, d2 = 14.3, d3 = 116.0 mm are published. Here the back suite is centred on the
    axis: {1} and {2} then fit the 26 mm box and {3} the handle.
    """

    positions_mm: tuple[Vector, Vector, Vector] = ((10.1, -10.1, 0.0), (-10.1, 10.1, 0.0), (4.2, 4.2, 116.0))
    """{1} senses x and z, {2} y and z, {3} x and y."""
    position_spread_mm: NotNegative = 0.2
    tip_mm: Vector = (0.0, 0.0, 155.0)
    """Tool tip with the manipulator at neutral."""


class SensorConfig(_Table):
    """Holds the errors of ADXL-203, TMP36, HMC-2003 and the DAQ's analog side, with sizes from their data sheets
    (ADXL-203 rev. D, table 1)."""

    noise_ug_per_rtHz: NotNegative = 110.0
    """ADXL-203, white before the RC (errata no. 25)."""
    range_g: Positive = 1.7
    rc_ohm: Positive = 32e3
    rc_farad: Positive = 0.33e-6
    rc_spread: NotNegative = 0.03
    """The data sheet allows 24 to 40 kOhm for the internal resistor; one lot is much closer."""
    bias_spread_V: NotNegative = 0.025
    scale_spread: NotNegative = 0.012
    misalignment_deg: NotNegative = 0.5
    cross_quadratic_V_per_g2: NotNegative = 0.003
    """Bias that follows the square of another axis (Ang 2004 (3.8), (3.10); form published, size ours)."""
    cross_linear_V_per_g: NotNegative = 0.004
    scale_variation_per_g: NotNegative = 0.002
    """Sensitivity that follows the out-of-plane axis (Ang 2004 (3.12))."""
    cross_fold_V: NotNegative = 0.001
    """Bias that follows the in-plane axis a as sqrt(1 + (a / 0.4 g)^2) - 1: no polynomial (ours)."""
    cross_product_V_per_g2: NotNegative = 0.001
    """Sensitivity that follows the in-plane axis, which Ang 2004 (3.12) does not know (ours)."""
    spring_per_g2: NotNegative = 0.0005
    """Relative change of sensitivity with the square of the own axis (data sheet: nonlinearity 0.5 % of full scale)."""
    bias_temperature_mg_per_K: NotNegative = 0.1
    scale_temperature_per_K: NotNegative = 5e-5

    supply_V: Positive = 5.0
    supply_spread: NotNegative = 0.004
    supply_wander_mV: NotNegative = 1.0
    divider_spread: NotNegative = 0.001
    temperature_offset_K: NotNegative = 0.7

    magnetometer_noise_uG: NotNegative = 40.0
    """Noise per sample of the HMC-2003 at 1 kHz bandwidth, rms (its resolution)."""
    magnetometer_offset_V: NotNegative = 0.01
    """Bridge and amplifier offset: does not change sign with the strap."""
    magnetometer_scale_spread: NotNegative = 0.01
    magnetometer_misalignment_deg: NotNegative = 1.0
    hard_iron_mG: NotNegative = 5.0
    soft_iron: NotNegative = 0.005
    piezo_coupling_G_per_A: NotNegative = 0.1

    daq_noise_uV: NotNegative = 150.0
    """Noise per sample at the +-5 V range, rms, before quantisation."""
    daq_offset_uV: NotNegative = 300.0
    daq_gain_spread: NotNegative = 2e-4


class StackConfig(_Table):
    """Describes a stack like the P-885.50: generalised Maxwell slip with viscous slip (``sim_devices.plant.stack``)."""

    stroke_um_at_100_V: Positive = 15.0
    """Quasi-static, 0 to 100 V and back."""
    stroke_spread: NotNegative = 0.03
    slip_sum: Annotated[float, Field(ge=0, lt=1)] = 0.52
    """Sum of the slip weights: 1 - slip_sum is the small-signal part; sets the loop (Ang 2004 Tables 7.1, 7.2)."""
    slip_spread: NotNegative = 0.03
    slip_limit_V: Positive = 46.0
    """Largest threshold."""
    slip_bias: NotNegative = 0.12
    """Relative fall of the thresholds from 50 to 100 V, rise to 0 V: minor loops are not congruent."""
    slip_viscous_ms: Positive = 0.6
    """Median viscous time of the slip: the loop opens with the rate."""
    curvature: float = -0.05
    """Static curvature, c of x = y + c (y^2 - y), y = 0..1."""
    creep_per_decade: NotNegative = 0.011
    resonance_hz: Positive = 650.0
    """Stack with lever and shaft."""
    damping: Positive = 0.04
    resonance_spread: NotNegative = 0.03
    expansion_um_per_K: float = -0.07
    """18 mm of poled ceramic."""


class AmplifierConfig(_Table):
    """Describes the piezo amplifier. ``gain``, limits and ``neutral_V`` follow the output's entry under [device]."""

    gain: Positive = 20.0
    """Output volts per volt of the DAC in front of it."""
    bandwidth_hz: Positive = 2000.0
    slew_V_per_ms: Positive = 40.0
    low_V: float = 0.0
    high_V: float = 100.0
    output_ohm: Positive = 10.0
    stack_farad: Positive = 1.5e-6
    gain_per_K: float = 0.0
    """Relative change of the gain for each kelvin above 25 degC."""
    neutral_V: float = 50.0
    """Output without a command, in V."""

    @model_validator(mode="after")
    def _within(self) -> AmplifierConfig:
        if not self.low_V <= self.neutral_V <= self.high_V:
            raise ValueError(f"neutral_V = {self.neutral_V} is outside [{self.low_V}, {self.high_V}] V")
        return self


class ManipulatorConfig(_Table):
    """Describes the manipulator (Ang 2004 ch. 6, errata nos. 58 to 71). Values that are not published are ours.

    With R = r = 5 mm and 120 um of ball travel, > 1000 um of total travel in x and y needs a shaft of at least
    36.1 mm; 40 mm gives 1280 x 1108 x 120 um.
    """

    circle_mm: Positive = 5.0
    """R = r: pin and ball circle."""
    shaft_mm: Positive = 40.0
    lever_gain: Positive = 8.0
    lever_spread: NotNegative = 0.02
    mount_spread_deg: NotNegative = 0.5
    """Turn of the manipulator frame against the body about z."""
    tilt_spread_deg: NotNegative = 0.3
    """Rotation of the mounting about x and y."""
    length_spread: NotNegative = 0.01
    """Relative, of circle and shaft."""
    rest_spread_um: NotNegative = 20.0
    """Ball heights at neutral: what the calibration screws leave (Ang 2004, 6.2)."""
    mount_play_um: NotNegative = 0.0
    """Play of a loose mount, along each axis of the body: after a reversal the tip stands still for so much motion."""


class EnvironmentConfig(_Table):
    gravity_m_s2: Positive = 9.80131
    field_uT: Positive = 48.0
    dip_deg: float = 66.0
    """Below the horizon toward north."""
    ambient_C: float = 22.0
    ambient_wander_K: NotNegative = 0.2
    warm_up_K: float = 6.0
    """Rise of the sensor board above ambient (Ang 2004 Fig. 3.11: steady after about 7 h)."""
    warm_up_s: Positive = 6300.0
    on_since_s: NotNegative = 900.0
    """Time for which the instrument has been switched on when the run starts."""


class ImuConfig(_Table):
    """Holds ``[emulation.imu.DEVICE]``: the mounting of the IMU of that name and the size of its errors."""

    position_mm: Vector = (0.0, 0.0, 0.0)
    """Position in the body frame; on the instrument it is measured from the base of the back suite."""
    turn_deg: Vector = (0.0, 0.0, 0.0)
    """Roll, pitch, yaw of the sensor's axes in the body."""
    errors: NotNegative = 1.0
    """Scales bias, scale, misalignment and temperature errors; 0 is an ideal chip."""
    noise: NotNegative = 1.0


class DaqConfig(_Table):
    """Holds ``[emulation.daq]``."""

    fifo_samples: Annotated[int, Field(ge=64)] = 1024
    """Number of samples that a DI-4108 keeps for a host that does not read: 128 ms of eight channels at 1 kHz.

    A value above that of the real part serves a test machine that suspends the process for longer than that."""
    delay_ms: Annotated[float, Field(ge=0, le=10)] = 0.0
    """Age of an accelerometer's voltage when it is converted, as behind a digital filter of linear phase."""


class MoreAxis(_Table):
    """Holds an entry of ``[[emulation.more_axes]]``: an accelerometer axis beyond the six, in place of supply or
    temperature."""

    input: Literal[6, 7]
    """Input of the DAQ."""
    position_mm: Vector
    direction: Vector
    bias_V: float = 0.0
    scale_V_per_g: float = 1.0


class EndoscopeConfig(_Table):
    """Holds ``[emulation.endoscope]``: a loose body instead of the instrument (``sim_devices.plant.scanner``)."""

    scenario: Literal["rest", "turntable", "fall", "poses", "hand", "led"] = "hand"
    """Motion of the body. With "led", a caller moves it (``Scanner.lead``)."""
    attitude_deg: Vector = (0.0, 0.0, 0.0)
    """Roll, pitch, yaw at the start."""

    rate_dps: float = 90.0
    start_s: NotNegative = 1.0
    ramp_s: NotNegative = 0.5
    radius_m: NotNegative = 0.0
    """Radius of the turntable, from its axis to the body's origin along the world's x at the start."""

    fall_at_s: NotNegative = 1.0
    fall_m: Positive = 1.0

    poses: tuple[tuple[NotNegative, float, float, float, Positive], ...] = ()
    """Start s, roll, pitch, yaw deg, duration s of each move."""

    sweep_deg: NotNegative = 15.0
    tremor_deg: NotNegative = 0.2
    tremor_um: NotNegative = 100.0

    presses: tuple[tuple[NotNegative, Positive], ...] = ()
    """The motion card's button, by itself: (start s, how long s) of each press, in order."""

    start_C: float = 25.0
    end_C: float = 25.0
    thermal_s: Positive = 300.0
    """The room goes from ``start_C`` to ``end_C`` with this time constant."""


class ServeConfig(_Table):
    """Says where a world in a process of its own serves its buses, besides ptys and sockets (``micron emulate``)."""

    tcp_port: Annotated[int, Field(ge=0, le=65_000)] | None = None
    """TCP port of the first serial bus; the next ones follow. 0 takes free ports, ``None`` serves none."""
    can: tuple[str, ...] = ()
    """CAN interfaces of the kernel for the CAN buses, in their order; further buses are on UDP multicast."""


class EmulationConfig(_Table):
    """Holds the whole ``[emulation]`` table."""

    provider: str = "sim_devices.register:provider"
    unit: Annotated[int, Field(ge=0)] = 1
    """Number of the physical instrument, which selects the individual errors of its sensors and stacks.

    Calibration files belong to one unit."""
    seed: Annotated[int, Field(ge=0)] = 1
    """Seed of the hand's motion and of all noise."""
    truth_s: Positive | None = None
    """Duration of the physical truth that is kept at least; ``None`` keeps all of it."""
    hand: HandConfig = HandConfig()
    instrument: InstrumentConfig = InstrumentConfig()
    sensors: SensorConfig = SensorConfig()
    stack: StackConfig = StackConfig()
    amplifier: AmplifierConfig = AmplifierConfig()
    manipulator: ManipulatorConfig = ManipulatorConfig()
    environment: EnvironmentConfig = EnvironmentConfig()
    endoscope: EndoscopeConfig | None = None
    daq: DaqConfig = DaqConfig()
    serve: ServeConfig = ServeConfig()
    imu: dict[str, ImuConfig] = Field(default_factory=dict)
    more_axes: tuple[MoreAxis, ...] = Field(default=(), max_length=2)
    twin: str | tuple[str, str, str] | None = None
    """Corrected twin (``micron mismatch apply``) in place of the stacks, or one for each; relative to the bench."""

    @model_validator(mode="after")
    def _delayed_alike(self) -> EmulationConfig:
        if self.daq.delay_ms and self.more_axes:
            raise ValueError("daq.delay_ms delays six accelerometer axes only; it cannot be combined with more_axes")
        return self


def emulation_config(description: Mapping[str, Any]) -> EmulationConfig:
    """Return the checked ``[emulation]`` table; its amplifier follows the bench's output. ``BenchError`` names each
    wrong key."""
    table = dict(description["emulation"])
    amplifier = table.get("amplifier", {})
    if isinstance(amplifier, Mapping):
        table["amplifier"] = _follow_output(amplifier, description.get("device", {}))
    try:
        return EmulationConfig.model_validate(table)
    except ValidationError as error:
        bench = f"bench '{description['name']}': " if description.get("name") else ""
        raise BenchError(describe_validation_error(error, f"{bench}[emulation]")) from error


def _follow_output(amplifier: Mapping[str, Any], devices: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the amplifier's table with the gain and the neutral voltage of the bench's output, and rails that reach
    as far as its limits. ``BenchError`` where both tables name a neutral voltage and they differ."""
    table, nominal = dict(amplifier), AmplifierConfig()
    for name, device in devices.items():
        if "neutral_V" not in device:
            continue
        neutral_V = device["neutral_V"]
        if table.setdefault("neutral_V", neutral_V) != neutral_V:
            raise BenchError(
                f"[emulation.amplifier] neutral_V = {table['neutral_V']}, but [device.{name}] says {neutral_V}: leave "
                "it out, the emulated stacks rest where the output does"
            )
        table.setdefault("low_V", min(nominal.low_V, device.get("lo_V", nominal.low_V)))
        table.setdefault("high_V", max(nominal.high_V, device.get("hi_V", nominal.high_V)))
        table.setdefault("gain", device.get("gain", nominal.gain))
    return table
