"""The bench file that the Setup view describes: a commented text, checked as ``micron doctor`` checks it."""

from __future__ import annotations

import json
import re
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hal.bench import load_bench
from hal.errors import HalError
from tools.bench.recorder import check_name
from tools.bench.requests import text
from tools.diagnose.findings import bench_findings
from tools.errors import InputError

AXES = ("1x", "1z", "2y", "2z", "3x", "3y")
PLACES = (*AXES, "supply", "temperature")
"""Uses of the converter's inputs. The axes are those of the drawing of the instrument."""
INPUTS = 8
_URIS = {
    "daq0": r"serial:///dev/[\w./:+-]+|sim://daq0",
    "i2c0": r"linux-i2c://\d+|sim://i2c0",
    "i2c1": r"linux-i2c://\d+|sim://i2c1",
    "e7270": r"serial:///dev/[\w./:+-]+|sim://e7270",
    "can0": r"socketcan://[\w-]+|sim://can0",
}
_BUSES = {  # kind, what hangs on it, more keys
    "daq0": ("serial", "the converter of the accelerometers", ""),
    "i2c0": ("i2c", "the outputs, and nothing that could hold them up", "speed_hz = 400_000"),
    "i2c1": ("i2c", "the slow converters", "speed_hz = 400_000"),
    "e7270": ("serial", "the controller of the outputs", "baud = 115_200"),
    "can0": ("can", "telemetry for other programs", "bitrate = 500_000"),
}
_SENSORS = {"acc1": "xz", "acc2": "yz", "acc3": "xy"}
DAQS = {"di4108": "DATAQ DI-4108", "nidaqmx": "NI card (NI-DAQmx)"}
OUTPUTS = {  # name for people, bus, delay in s from a sample to the effect of its command (this project's benches)
    "dac_amplifier": ("AD5696R and amplifier, I2C", "i2c0", 0.0017),
    "e727": ("PI E-727, serial", "e7270", 0.0070),
    "can_amplifier": ("piezo node on CAN", "can0", 0.0015),
    "nidaqmx_ao": ("NI card and amplifier", "", 0.0017),
}


@dataclass(frozen=True)
class Draft:
    """Holds a bench as a person described it. ``inputs`` is the converter's input of each of ``PLACES``. Addresses on
    I2C are None for a part that the bench lacks. ``cards``: names of NI cards for "daq" and "output", where they are
    some."""

    name: str
    uris: dict[str, str]
    inputs: dict[str, int]
    daq: str
    output: str
    cards: dict[str, str]
    piezo: int | None
    magnetometer: int | None
    monitor: int | None
    telemetry: bool

    @property
    def emulated(self) -> bool:
        return any(uri.startswith("sim://") for uri in self.uris.values())


def read_draft(table: dict[str, Any]) -> Draft:
    """Return the draft in a request. ``InputError`` names the field that is wrong."""
    name = check_name(text(table, "name", longest=80).strip())
    magnetometer, monitor = (_address(table, part) for part in ("magnetometer", "monitor"))
    daq, output = text(table, "daq", "di4108"), text(table, "output", "dac_amplifier")
    if daq not in DAQS or output not in OUTPUTS:
        raise InputError(f"the converter is one of {', '.join(DAQS)}, the output one of {', '.join(OUTPUTS)}")
    cards = {
        part: _card(table, part) for part, kind in (("daq", daq), ("output", output)) if kind.startswith("nidaqmx")
    }
    piezo = _address(table, "piezo") if output == "dac_amplifier" else None
    if piezo is None and output == "dac_amplifier":
        raise InputError("the output needs the address of its DAC")
    telemetry = table.get("telemetry") is True
    wanted = {"daq0": daq == "di4108", "i2c1": magnetometer or monitor, "can0": telemetry}
    needed = [bus for bus in _BUSES if wanted.get(bus) or bus == OUTPUTS[output][1]]
    given = table.get("uris")
    uris: dict[str, str] = {}
    for bus in needed:
        uri = given.get(bus) if isinstance(given, dict) else None
        if not isinstance(uri, str) or not re.fullmatch(_URIS[bus], uri):
            raise InputError(f"{bus}: {uri!r} is no address of such a bus; choose one that was found, or type it")
        uris[bus] = uri
    real = [uri for uri in uris.values() if not uri.startswith("sim://")]
    if len(set(real)) < len(real):
        raise InputError("two buses have the same address: the outputs need a bus of their own")
    return Draft(
        name, uris, _inputs(table.get("inputs")), daq, output, cards, piezo, magnetometer, monitor, telemetry
    )  # fmt: skip


def _card(table: dict[str, Any], part: str) -> str:
    card = text(table, f"{part}_card", longest=60).strip()
    if not re.fullmatch(r"[A-Za-z][\w-]*", card):
        raise InputError(f"{part}: {card!r} is no name of an NI card; NI MAX or `nilsdev` lists them, as Dev1")
    return card


def _address(table: dict[str, Any], part: str) -> int | None:
    value = table.get(part)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int) or not 0x08 <= value <= 0x77:
        raise InputError(f"{part}: {value!r} is no I2C address; choose one from 0x08 to 0x77")
    return value


def _inputs(given: Any) -> dict[str, int]:
    if not isinstance(given, dict):
        raise InputError("inputs: choose for each axis the input of the converter that it is wired to")
    inputs: dict[str, int] = {}
    for place in PLACES:
        value = given.get(place)
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < INPUTS:
            raise InputError(f"{place} has no input; drag one of the {INPUTS} to it")
        if value in inputs.values():
            other = next(p for p, v in inputs.items() if v == value)
            raise InputError(f"input {value} is both {other} and {place}; each input is for one")
        inputs[place] = value
    return inputs


STILL_TIP = (
    "[firmware.tremor.adaptive]", 'preset = "still tip"', "reading_noise_m_s2 = 4.2e-3", "",
    "[firmware.actuation]", "centring = 1.0",
)  # fmt: skip
"""The project's own benches have these where the output takes a command a tick (``AdaptiveConfig.preset``)."""


def bench_text(draft: Draft, calibrations: list[str]) -> str:
    """Return the bench file as a text with comments."""
    uris, inputs = draft.uris, draft.inputs
    lines = [
        "# Made by the Setup view of `micron bench`. `micron doctor --bench FILE` checks it; nothing moves there.",
        "format = 1", f"name = {json.dumps(draft.name)}", "", "[clock]", "tick_hz = 1000", "",
    ]  # fmt: skip
    if draft.emulated:
        lines += [
            "[emulation] # read only for buses whose URI starts with sim://",
            'provider = "sim_devices.register:provider"', "unit = 1", "seed = 1", "",
        ]  # fmt: skip
    for bus, uri in uris.items():
        kind, comment, more = _BUSES[bus]
        if bus == "can0" and draft.output == "can_amplifier":
            comment = "the node of the outputs, and telemetry" if draft.telemetry else "the node of the outputs"
        lines += [f"[bus.{bus}] # {comment}", f'kind = "{kind}"', f"uri = {json.dumps(uri)}"]
        lines += [more, ""] if more else [""]
    lines += [
        f"[device.daq] # {DAQS[draft.daq]}", f'driver = "{draft.daq}"',
        f"device = {json.dumps(draft.cards['daq'])}" if draft.daq == "nidaqmx" else 'bus = "daq0"', "rate_hz = 1000",
        f"channels = {sorted(inputs.values())}", "range_V = 5.0", "",
    ]  # fmt: skip
    for device, axes in _SENSORS.items():
        wired = ", ".join(f"{axis} = {inputs[device[-1] + axis]}" for axis in axes)
        channels = f"channels = {{ {wired} }}"
        lines += [f"[device.{device}] # inputs of its axes", 'driver = "adxl203"', 'daq = "daq"', channels, ""]
    for device, what in (("supply", "half the sensors' supply"), ("temperature", "TMP36")):
        lines += [f"[device.{device}] # {what}", 'driver = "analog"', 'daq = "daq"', f"channel = {inputs[device]}", ""]
    if draft.magnetometer is not None:
        lines += [
            "[device.mag_adc]", 'driver = "ads1115"', 'bus = "i2c1"', f"address = {draft.magnetometer:#04x}",
            "rate_hz = 100", "", "[device.mag]", 'driver = "hmc2003"', 'adc = "mag_adc"', "channels = [0, 1, 2]", "",
        ]  # fmt: skip
    else:
        lines += ["# no magnetometer: heading drifts with the rate's error; attitude holds by gravity alone", ""]
    if draft.monitor is not None:
        lines += [
            "[device.monitor_adc] # sense wires at the stacks, behind dividers", 'driver = "ads1115"', 'bus = "i2c1"',
            f"address = {draft.monitor:#04x}", "",
            "[device.monitor]", 'driver = "amplifier_monitor"', 'adc = "monitor_adc"', "channels = [0, 1, 2]",
            "ratio = 20.0", "tolerance_V = 0.3", "",
        ]  # fmt: skip
    else:
        lines += ["# no monitor: an amplifier that does not obey is not noticed", ""]
    title, bus, delay_s = OUTPUTS[draft.output]
    lines += [f"[device.piezo] # {title}", f'driver = "{draft.output}"', *([f'bus = "{bus}"'] if bus else [])]
    if draft.piezo is not None:
        lines += [f"address = {draft.piezo:#04x}", "gain = 20.0 # of the amplifier: output volts per volt of the DAC"]
    elif draft.output == "nidaqmx_ao":
        card = json.dumps(draft.cards["output"])
        lines += [f"device = {card}", "channels = [0, 1, 2]", "gain = 20.0 # of the amplifier: output per card volt"]
    elif draft.output == "e727":
        lines += ["rate_hz = 100 # commands a second; a frame takes 1.3 ms of the wire"]
    lines += ["neutral_V = 50.0", ""]
    if draft.telemetry:
        lines += ["[device.telemetry]", 'driver = "can_telemetry"', 'bus = "can0"', ""]
    lines += [
        "[firmware]",
        "# These belong to another unit until you have calibrated yours (docs/lab-machine.md, 6)."
        if calibrations
        else "# No calibration yet: `micron calibrate` and the Calibrate view make them (docs/lab-machine.md, 6).",
        f"calibration = {json.dumps(calibrations)}", "",
        "[firmware.sensing] # where the sensors and the tip sit, m; `micron calibrate positions` refines it",
        "positions_m = [[0.0101, -0.0101, 0.0], [-0.0101, 0.0101, 0.0], [0.0042, 0.0042, 0.116]]",
        "tip_m = [0.0, 0.0, 0.155]", "",
        "[firmware.tremor]", f"loop_delay_s = {delay_s} # sample to what the command does, on the emulated bench",
        *(() if draft.output == "e727" else STILL_TIP),
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def checked(content: str, folder: Path) -> list[dict[str, str]]:
    """Return what ``micron doctor`` finds for a bench file of this text in ``folder``. ``InputError``: it refuses."""
    with tempfile.NamedTemporaryFile("w", suffix=".toml", prefix=".setup-", dir=folder, encoding="utf-8") as file:
        file.write(content)
        file.flush()
        try:
            findings = bench_findings(load_bench(Path(file.name)))
        except HalError as error:
            raise InputError(str(error).replace(file.name, "the bench file")) from None
    return [{"part": f.part, "verdict": f.verdict, "detail": f.detail, "remedy": f.remedy} for f in findings]
