"""Defines the checked entries of a bench file for every driver."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from hal.types import OutputLimit

Channel = Annotated[int, Field(ge=0, le=7)]


class Options(BaseModel):
    """Holds a driver's own keys of a bench file; unknown ones are refused. Units are in the names of the keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class DaqOptions(Options):
    """Holds the keys of every DAQ's entry; a driver may narrow them. ``channels`` are in the order of a scan."""

    rate_hz: float = Field(gt=0)
    channels: tuple[int, ...] = Field(min_length=1)
    range_V: float = Field(gt=0)


class OutputOptions(Options):
    """Checks the keys of every analog output's entry: the neutral voltage at the stack lies between its limits.

    A subclass has ``lo_V`` and ``hi_V``."""

    neutral_V: float = 50.0
    slew_V_per_s: float = Field(default=20_000.0, ge=100.0, le=1e6)

    @property
    def limit(self) -> OutputLimit:
        """Return the limits of each output, which the actuation stage follows."""
        low, high = (getattr(self, name) for name in ("lo_V", "hi_V"))
        return OutputLimit(low, high, self.slew_V_per_s, self.neutral_V)

    @model_validator(mode="after")
    def _neutral_is_between(self) -> OutputOptions:
        low, neutral, high = (getattr(self, name) for name in ("lo_V", "neutral_V", "hi_V"))
        if not low <= neutral <= high or low == high:
            raise ValueError(f"lo_V = {low:g} <= neutral_V = {neutral:g} <= hi_V = {high:g} does not hold")
        return self


def one_of(*allowed: float) -> AfterValidator:
    """Return a validator for a number that must be one of ``allowed``."""

    def check(value: float) -> float:
        if value not in allowed:
            raise ValueError(f"{value:g} is not one of {', '.join(f'{a:g}' for a in allowed)}")
        return value

    return AfterValidator(check)


class Di4108Options(DaqOptions):
    """Holds the keys of a DATAQ DI-4108. ``rate_hz`` per channel must divide 60 MHz/375 (protocol manual,
    ``srate``)."""

    rate_hz: float = Field(gt=0, le=160_000)
    channels: tuple[Channel, ...] = Field(min_length=1, max_length=8)
    range_V: Annotated[float, one_of(10.0, 5.0, 2.0, 1.0, 0.5, 0.2)]


class NiDaqOptions(DaqOptions):
    """Holds the keys of a National Instruments analog input, used through the ``nidaqmx`` package."""

    device: str
    channels: tuple[Annotated[int, Field(ge=0, le=31)], ...] = Field(min_length=1)
    range_V: float = Field(gt=0, le=10)


class Adxl203Options(Options):
    """Holds the keys of one ADXL-203: the DAQ channel of each axis, named in the instrument's body frame."""

    channels: dict[Literal["x", "y", "z"], Channel] = Field(min_length=1, max_length=2)


class AnalogOptions(Options):
    """Holds the keys of a plain analog quantity on one DAQ channel."""

    channel: Channel


class Ads1115Options(Options):
    """Holds the keys of an ADS1115, which converts its single-ended channels one after the other.

    ``rate_hz`` is the rate of each input of a magnetometer; the default is 100 Hz. A converter that an amplifier
    monitor reads has the monitor's rate.
    """

    rate_hz: float | None = Field(default=None, gt=0, le=286.0)
    full_scale_V: Annotated[float, one_of(6.144, 4.096, 2.048, 1.024, 0.512, 0.256)] = 6.144


class Hmc2003Options(Options):
    """Holds the keys of an HMC-2003: the ADC channels of x, y, z. Two digital outputs of the DAQ drive its strap."""

    channels: tuple[Annotated[int, Field(ge=0, le=3)], ...] = Field(default=(0, 1, 2), min_length=3, max_length=3)


class AmplifierMonitorOptions(Options):
    """Holds the keys of an amplifier monitor: output volts = ADC volts x ``ratio``.

    ``rate_hz``: readings per second, of one output each. The default is two in five ticks, fewer if conversions take
    longer than that.
    """

    channels: tuple[Annotated[int, Field(ge=0, le=3)], ...] = Field(default=(0, 1, 2), min_length=3, max_length=3)
    ratio: float = Field(default=20.0, ge=0.01, le=1000)
    tolerance_V: float = Field(default=0.5, ge=0.01, le=50.0)
    settle_ms: float = Field(default=0.3, ge=0, le=10.0)
    change_V: float = Field(default=0.15, ge=0.01, le=50.0)
    rate_hz: float | None = Field(default=None, gt=0, le=860.0)


class DacAmplifierOptions(OutputOptions):
    """Holds the keys of an AD5696R with an amplifier: output volts = DAC volts x ``gain``.

    ``read_back``: every command is read back within its own transfer, which takes 0.21 ms more on the bus; the task
    budgets must leave room for it.
    """

    gain: float = Field(default=20.0, ge=0.1, le=100)
    lo_V: float = Field(default=0.0, ge=0)
    hi_V: float = Field(default=100.0, le=150)
    read_back: bool = False


class E727Options(OutputOptions):
    """Holds the keys of a PI E-727 over GCS 2.0, whose voltages are commanded in open loop."""

    lo_V: float = Field(default=0.0, ge=-30)
    hi_V: float = Field(default=100.0, le=120)
    rate_hz: float = Field(default=100.0, gt=0, le=200)


class NiOutputOptions(OutputOptions):
    """Holds the keys of National Instruments analog outputs: output volts = card volts x ``gain``."""

    device: str
    channels: tuple[Annotated[int, Field(ge=0, le=31)], ...] = Field(default=(0, 1, 2), min_length=3, max_length=3)
    gain: float = Field(default=20.0, ge=0.1, le=100)
    lo_V: float = Field(default=0.0, ge=-150)
    hi_V: float = Field(default=100.0, le=150)


class CanAmplifierOptions(OutputOptions):
    """Holds the keys of the CAN piezo node (``drivers/dbc/micron.dbc``), whose set points are 0 to 100 V."""

    lo_V: ClassVar[float] = 0.0
    hi_V: ClassVar[float] = 100.0

    neutral_V: float = Field(default=50.0, ge=0, le=100)


class CanTelemetryOptions(Options):
    """Holds the keys of telemetry and stop button. ``stop_button``: a missing heartbeat of the button is a fault."""

    stop_button: bool = True


class MotionCardOptions(Options):
    """Holds the keys of a motion card behind its scanner card. ``fields``: the text carries counts ("raw"), or g,
    deg/s and degC ("scaled")."""

    rate_hz: float = Field(default=100.0, gt=0, le=1000)
    fields: Literal["raw", "scaled"] = "raw"
    spike_filter: bool = True


class BleMotionCardOptions(Options):
    """Holds the keys of a motion card over Bluetooth Low Energy (extra ``ble``): its advertised name or address."""

    peripheral: str = "CONTROL.CMR"
    rate_hz: float = Field(default=100.0, gt=0, le=100)
    spike_filter: bool = True
