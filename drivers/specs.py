"""What each driver's entry in a bench file may say, and the arithmetic that a bench must obey.

``hal.bench`` has checked references and addresses; here the drivers' own keys, channel claims, rates and the
time that each bus has per second are checked, so that an impossible bench is refused before it is opened.
"""

from __future__ import annotations

from collections import defaultdict
from typing import Annotated, Any, Literal

from pydantic import Field

from drivers.added import added_driver, added_load, added_names
from drivers.imu.bench import IMU_OPTIONS, ImuOptions, address_problems, bus_load
from drivers.motion_card_protocol import LINE_BYTES
from drivers.options import BusLoad, DaqOptions, Options, one_of
from hal.bench import BenchDescription, CanSpec, I2cSpec, SerialSpec
from hal.errors import BenchError
from hal.validation import validate_table

Channel = Annotated[int, Field(ge=0, le=7)]


class Di4108Options(DaqOptions):
    """DATAQ DI-4108. ``rate_hz`` per channel must divide 60 MHz/375 (protocol manual, ``srate``)."""

    rate_hz: float = Field(gt=0, le=160_000)
    channels: tuple[Channel, ...] = Field(min_length=1, max_length=8)
    range_V: Annotated[float, one_of(10.0, 5.0, 2.0, 1.0, 0.5, 0.2)]


class NiDaqOptions(DaqOptions):
    """National Instruments analog input through the ``nidaqmx`` package."""

    device: str
    rate_hz: float = Field(gt=0)
    channels: tuple[Annotated[int, Field(ge=0, le=31)], ...] = Field(min_length=1)
    range_V: float = Field(gt=0, le=10)


class Adxl203Options(Options):
    """One ADXL-203: the DAQ channel of each of its axes, named in the instrument's body frame."""

    channels: dict[Literal["x", "y", "z"], Channel] = Field(min_length=1, max_length=2)


class AnalogOptions(Options):
    """A plain analog quantity on one DAQ channel."""

    channel: Channel


class Ads1115Options(Options):
    """ADS1115, single-ended channels one after the other."""

    rate_hz: float = Field(default=100.0, gt=0, le=286.0)
    full_scale_V: Annotated[float, one_of(6.144, 4.096, 2.048, 1.024, 0.512, 0.256)] = 6.144


class Hmc2003Options(Options):
    """HMC-2003 behind an ADC: the channels of x, y, z; the strap hangs on two digital outputs of the DAQ."""

    channels: tuple[Annotated[int, Field(ge=0, le=3)], ...] = Field(default=(0, 1, 2), min_length=3, max_length=3)
    strap_daq: str = "daq"


class AmplifierMonitorOptions(Options):
    """Monitor voltages of the amplifier's three outputs on an ADC: output volts = ADC volts x ``ratio``."""

    channels: tuple[Annotated[int, Field(ge=0, le=3)], ...] = Field(default=(0, 1, 2), min_length=3, max_length=3)
    ratio: float = Field(default=20.0, gt=0, le=1000)
    tolerance_V: float = Field(default=0.5, gt=0)
    settle_ms: float = Field(default=0.3, ge=0, le=10.0)
    change_V: float = Field(default=0.15, gt=0)


class DacAmplifierOptions(Options):
    """AD5696R and an amplifier: output volts = DAC volts x ``gain``.

    ``read_back``: every command is read back within its own transfer; takes 0.21 ms more of the bus, and task budgets
    that leave room for it.
    """

    gain: float = Field(default=20.0, gt=0, le=100)
    lo_V: float = 0.0
    hi_V: float = Field(default=100.0, le=150)
    neutral_V: float = 50.0
    slew_V_per_s: float = Field(default=20_000.0, gt=0)
    read_back: bool = False


class E727Options(Options):
    """PI E-727 over GCS 2.0, open loop: volts are commanded as open-loop values."""

    lo_V: float = 0.0
    hi_V: float = Field(default=100.0, le=120)
    neutral_V: float = 50.0
    slew_V_per_s: float = Field(default=20_000.0, gt=0)
    rate_hz: float = Field(default=100.0, gt=0, le=200)


class NiOutputOptions(Options):
    """National Instruments analog outputs in front of the amplifier: output volts = card volts x ``gain``."""

    device: str
    channels: tuple[Annotated[int, Field(ge=0, le=31)], ...] = Field(default=(0, 1, 2), min_length=3, max_length=3)
    gain: float = Field(default=20.0, gt=0, le=100)
    lo_V: float = 0.0
    hi_V: float = Field(default=100.0, le=150)
    neutral_V: float = 50.0
    slew_V_per_s: float = Field(default=20_000.0, gt=0)


class CanAmplifierOptions(Options):
    """The CAN piezo node of ``drivers/dbc/micron.dbc``."""

    neutral_V: float = 50.0
    slew_V_per_s: float = Field(default=20_000.0, gt=0)


class CanTelemetryOptions(Options):
    """Telemetry frames out, stop button in. ``stop_button`` says that a missing button heartbeat is a fault."""

    stop_button: bool = True


class MotionCardOptions(Options):
    """Motion card behind its scanner card. ``fields``: does the text carry counts or g, deg/s and degC?"""

    rate_hz: float = Field(default=100.0, gt=0, le=1000)
    fields: Literal["raw", "scaled"] = "raw"
    spike_filter: bool = True


class BleMotionCardOptions(Options):
    """Motion card over Bluetooth Low Energy (extra ``ble``): advertised name or address of the card."""

    peripheral: str = "CONTROL.CMR"
    rate_hz: float = Field(default=100.0, gt=0, le=100)
    spike_filter: bool = True


OPTIONS: dict[str, type[Options]] = {
    "di4108": Di4108Options,
    "nidaqmx": NiDaqOptions,
    "adxl203": Adxl203Options,
    "analog": AnalogOptions,
    "ads1115": Ads1115Options,
    "hmc2003": Hmc2003Options,
    "amplifier_monitor": AmplifierMonitorOptions,
    "dac_amplifier": DacAmplifierOptions,
    "e727": E727Options,
    "nidaqmx_ao": NiOutputOptions,
    "can_amplifier": CanAmplifierOptions,
    "can_telemetry": CanTelemetryOptions,
    **IMU_OPTIONS,
    "motion_card": MotionCardOptions,
    "ble_motion_card": BleMotionCardOptions,
}
"""Our drivers by the name used in a bench file; those of other packages come beside (``drivers.added``)."""

MONITOR_LOOKS = 0.4
"""Conversions per tick that an amplifier monitor makes, whatever its ADC's ``rate_hz``: a fault must be seen soon."""

NEEDS = {
    "di4108": "bus",
    "adxl203": "daq",
    "analog": "daq",
    "ads1115": "bus",
    "hmc2003": "adc",
    "amplifier_monitor": "adc",
    "dac_amplifier": "bus",
    "e727": "bus",
    "can_amplifier": "bus",
    "can_telemetry": "bus",
    "mpu6050": "bus",
    "lsm6ds3": "bus",
    "bmx055": "bus",
    "motion_card": "bus",
}


def device_options(description: BenchDescription, name: str, where: str) -> Any:
    """The checked options of device ``name``. Raises ``BenchError`` naming file and key."""
    spec = description.device[name]
    added = None if spec.driver in OPTIONS else added_driver(spec.driver)
    if spec.driver not in OPTIONS and added is None:
        known = ", ".join((*OPTIONS, *added_names()))
        raise BenchError(f"{where}: [device.{name}.driver] there is no driver '{spec.driver}'; drivers are {known}")
    needed = NEEDS.get(spec.driver) if added is None else added.needs
    if needed and getattr(spec, needed) is None:
        raise BenchError(f"{where}: [device.{name}] driver '{spec.driver}' needs '{needed} = ...'")
    return validate_table(
        OPTIONS[spec.driver] if added is None else added.options, spec.options(), f"{where}: device.{name}"
    )


def check_devices(description: BenchDescription, where: str) -> dict[str, Any]:
    """Options of every device by name, after all checks that need more than one of them."""
    options = {name: device_options(description, name, where) for name in description.device}
    problems = [
        *_channel_claims(description, options),
        *address_problems(description, options),
        *_rates(description, options),
        *_bus_time(description, options),
    ]
    if problems:
        raise BenchError("\n".join(f"{where}: {p}" for p in problems))
    return options


def _channel_claims(description: BenchDescription, options: dict[str, Any]) -> list[str]:
    problems: list[str] = []
    taken: dict[tuple[str, int], str] = {}
    for name, spec in description.device.items():
        claims: tuple[int, ...]
        parent = spec.daq or spec.adc
        match options[name]:
            case Adxl203Options(channels=channels):
                claims = tuple(channels.values())
            case AnalogOptions(channel=channel):
                claims = (channel,)
            case Hmc2003Options(channels=adc_channels) | AmplifierMonitorOptions(channels=adc_channels):
                claims = adc_channels
            case _:
                added = None if spec.driver in OPTIONS else added_driver(spec.driver)
                claims = () if added is None else added.inputs(options[name])
        if parent is None:
            continue
        offered: tuple[int, ...] = getattr(options[parent], "channels", (0, 1, 2, 3))
        for channel in claims:
            if channel not in offered:
                problems.append(f"[device.{name}] channel {channel} is not scanned by '{parent}' ({list(offered)})")
            if (parent, channel) in taken:
                problems.append(
                    f"[device.{name}] channel {channel} of '{parent}' is taken by '{taken[parent, channel]}'"
                )
            taken.setdefault((parent, channel), name)
    return problems


def _rates(description: BenchDescription, options: dict[str, Any]) -> list[str]:
    problems: list[str] = []
    tick_hz = description.clock.tick_hz
    for name, option in options.items():
        if isinstance(option, DaqOptions) and option.rate_hz != tick_hz:
            problems.append(
                f"[device.{name}.rate_hz] {option.rate_hz:g} Hz, but the scans drive the tick of {tick_hz} Hz; "
                "make them equal"
            )
        if isinstance(option, Di4108Options) and (60_000_000 / option.rate_hz) % 1:
            problems.append(f"[device.{name}.rate_hz] {option.rate_hz:g} Hz is no whole divisor of the 60 MHz clock")
        if isinstance(option, Ads1115Options) and tick_hz % option.rate_hz:
            problems.append(f"[device.{name}.rate_hz] {option.rate_hz:g} Hz does not divide the tick of {tick_hz} Hz")
    return problems


def _bus_time(description: BenchDescription, options: dict[str, Any]) -> list[str]:
    by_bus: dict[str, list[BusLoad]] = defaultdict(list)
    for load in bus_loads(description, options):
        by_bus[load.bus].append(load)
    problems: list[str] = []
    for bus, loads in by_bus.items():
        total = sum(load.share for load in loads)
        if total > 0.9:
            detail = "; ".join(f"{load.device} {load.arithmetic} = {100 * load.share:.0f} %" for load in loads)
            problems.append(
                f"[bus.{bus}] is asked for {100 * total:.0f} % of its time ({detail}); "
                "lower a rate, raise the bus speed or use a second bus"
            )
    return problems


def bus_loads(description: BenchDescription, options: dict[str, Any]) -> list[BusLoad]:
    """Share of its bus that each device takes. I2C: 9 bits a byte plus start and stop; CAN: worst stuffing."""
    tick_hz = description.clock.tick_hz
    monitors = {spec.adc for spec in description.devices_with("amplifier_monitor").values()}
    loads: list[BusLoad] = []
    for name, spec in description.device.items():
        bus = description.bus.get(spec.bus or "")
        if spec.driver not in OPTIONS:
            foreign = added_load(description, name, options[name])
            loads += [] if foreign is None else [foreign]
        elif isinstance(bus, I2cSpec):
            # DAC: four times address + 3 bytes, each after a START of its own (AD5696R knows one word per
            # address byte). ADC, per conversion: write 4 bytes, read 1 + 1 + 1 + 2 bytes.
            if isinstance(options[name], ImuOptions):
                loads.append(bus_load(options[name], spec.bus or "", bus.speed_hz, name))
            transfers = {
                "dac_amplifier": (tick_hz, 16, 4),
                "ads1115": (
                    MONITOR_LOOKS * tick_hz if name in monitors else 3 * getattr(options[name], "rate_hz", 0),
                    9,
                    2,
                ),
            }.get(spec.driver)
            if transfers:
                rate_hz, n_bytes, n_starts = transfers
                bits = 9 * n_bytes + 3 * n_starts
                text = f"{rate_hz:g} Hz x {bits} bit / {bus.speed_hz} Hz"
                loads.append(BusLoad(spec.bus or "", name, rate_hz * bits / bus.speed_hz, text))
        elif isinstance(bus, SerialSpec) and isinstance(options[name], MotionCardOptions):
            rate_hz: float = options[name].rate_hz
            text = f"{rate_hz:g} Hz x {LINE_BYTES} byte x 10 bit / {bus.baud} bit/s"
            share = rate_hz * LINE_BYTES * 10 / bus.baud
            loads.append(BusLoad(spec.bus or "", name, share, text))
        elif isinstance(bus, CanSpec):
            frames_hz = {"can_amplifier": tick_hz + 100 + 10 + 50, "can_telemetry": 50 * 3 + 10}.get(spec.driver)
            if frames_hz:
                text = f"{frames_hz} frames/s x 135 bit / {bus.bitrate} bit/s"
                loads.append(BusLoad(spec.bus or "", name, frames_hz * 135 / bus.bitrate, text))
    return loads
