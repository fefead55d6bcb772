"""Recordings on disk as the contract's section 1 says, in varied units and formats; nothing of the answer in them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from hal.arrays import Array
from tools.research.prove import guests
from tools.research.prove.draw import Case
from tools.research.prove.forms_memory import Rng

# other units of one dimension: value in this unit = value in the contract's unit * factor + shift
UNITS: dict[str, tuple[tuple[str, float, float], ...]] = {
    "V": (("V", 1.0, 0.0), ("mV", 1e3, 0.0)),
    "um": (("um", 1.0, 0.0), ("mm", 1e-3, 0.0), ("m", 1e-6, 0.0), ("nm", 1e3, 0.0)),
    "g": (("g", 1.0, 0.0), ("mg", 1e3, 0.0), ("m/s^2", 9.80665, 0.0)),
    "uT": (("uT", 1.0, 0.0), ("G", 1e-2, 0.0), ("nT", 1e3, 0.0)),
    "m/s^2": (("m/s^2", 1.0, 0.0), ("g", 1 / 9.80665, 0.0), ("mg", 1e3 / 9.80665, 0.0)),
    "rad/s": (("rad/s", 1.0, 0.0), ("deg/s", 180 / np.pi, 0.0)),
    "N": (("N", 1.0, 0.0), ("mN", 1e3, 0.0)),
    "m": (("m", 1.0, 0.0), ("mm", 1e3, 0.0), ("um", 1e6, 0.0)),
    "m/s": (("m/s", 1.0, 0.0), ("mm/s", 1e3, 0.0)),
    "degC": (("degC", 1.0, 0.0), ("K", 1.0, 273.15)),
    "A": (("A", 1.0, 0.0), ("mA", 1e3, 0.0)),
    "Pa": (("Pa", 1.0, 0.0),),
    "1": (("1", 1.0, 0.0),),
    "W": (("W", 1.0, 0.0), ("mW", 1e3, 0.0)),
    "rad": (("rad", 1.0, 0.0), ("mrad", 1e3, 0.0)),
}

SIGNAL_UNITS = {
    "command": "V",
    "displacement": "um",
    "force": "N",
    "position": "m",
    "velocity": "m/s",
    "temperature": "degC",
    "load": "N",
    "supply": "V",
    "actuator_current": "A",
    "current": "A",
    "pressure": "Pa",
    "humidity": "1",
    "drive": "V",
    "y": "V",
    "angle": "V",
    "speed": "V",
    "power": "W",
    "expansion": "um",
    "lift": "um",
}


STARTS = (
    ("voltage", "V"), ("field", "uT"), ("accel_", "m/s^2"), ("angular_rate", "rad/s"),
    # of the instrument
    ("command_", "V"), ("volts_", "V"), ("path_", "m"), ("angle_", "rad"), ("tip_", "m"),
)  # fmt: skip


def contract_unit(signal: str) -> str:
    """The unit of a signal in the contract's section 2."""
    if signal in SIGNAL_UNITS:
        return SIGNAL_UNITS[signal]
    for start, unit in STARTS:
        if signal.startswith(start):
            return unit
    if signal.startswith("specific_force"):
        return "g"
    raise KeyError(signal)


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value)
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{json.dumps(k)} = {_toml(v)}" for k, v in value.items()) + " }"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    if isinstance(value, int):
        return str(value)
    text = f"{float(value):.12g}"
    return text if any(c in text for c in ".en") else text + ".0"


def toml_text(head: dict[str, Any]) -> str:
    """A descriptor as TOML: plain keys first, then [twin], [split] and the channels."""
    lines = [f"{k} = {_toml(v)}" for k, v in head.items() if not isinstance(v, (dict, list))]
    twin = head["twin"]
    lines += ["", "[twin]", f"kind = {_toml(twin['kind'])}", "[twin.parameters]"]
    lines += [f"{k} = {_toml(v)}" for k, v in twin.get("parameters", {}).items()]
    if "split" in head:
        lines += ["", "[split]", *(f"{k} = {_toml(v)}" for k, v in head["split"].items())]
    for channel in head["channels"]:
        lines += ["", "[[channels]]", *(f"{k} = {_toml(v)}" for k, v in channel.items())]
    return "\n".join(lines) + "\n"


def _beside(case: Case, folder: Path) -> dict[str, Any]:
    """The descriptor's parameters; what a twin of somebody else needs is put where they say."""
    if case.scene.twin == guests.FMU:
        guests.build_fmu(folder / "model.fmu")
        return {"path": "model.fmu", "hold": "zero", **case.given}  # as the generator steps it
    if case.scene.twin == guests.INSTRUMENT:
        guests.write_bench(folder / "bench.toml", int(case.given["unit"]))
        return {"bench": "bench.toml"}
    if case.scene.twin == guests.USER:
        guests.install_user_twin(folder.parent.parent)
    return case.given


def write(case: Case, folder: Path, title: str, rng: Rng) -> Path:
    """Write descriptor and data; the path of the descriptor."""
    folder.mkdir(parents=True, exist_ok=True)
    scene = case.scene
    columns: dict[str, Array] = {}
    tables: list[dict[str, Any]] = []
    style = str(rng.choice(["plain", "named"]))
    signals = [("input", k, v) for k, v in scene.inputs.items()]
    signals += [("output", k, v) for k, v in case.recorded.items()]
    signals += [("context", k, v) for k, v in scene.contexts.items()]
    chosen: dict[str, tuple[str, float, float]] = {}
    for number, (role, signal, values) in enumerate(signals):
        base = "m/s^2" if scene.twin == "accelerometer_cluster" and signal.startswith("spec") else contract_unit(signal)
        # axes of one instrument share their unit
        family = role + base
        if family not in chosen:
            options = UNITS[base]
            chosen[family] = options[int(rng.integers(len(options)))] if rng.random() < 0.6 else options[0]
            if scene.twin in (guests.FMU, guests.USER):
                chosen[family] = options[0]  # such a twin gets what the recording says, in whatever unit
        unit, factor, shift = chosen[family]
        name = f"ch{number}" if style == "plain" else f"{signal}_{unit.replace('/', '_per_').replace('^', '')}"
        columns[name] = values[: scene.keep] * factor + shift
        table: dict[str, Any] = {"column": name, "role": role, "signal": signal, "unit": unit}
        if role == "output" and case.declared:
            table["noise_rms"] = case.noise_rms[signal] * factor
        tables.append(table)
    head: dict[str, Any] = {"format": 1, "title": title}
    timed = rng.random() < 0.3
    if timed:
        columns = {"t_s": scene.t[: scene.keep], **columns}
        head["time_column"] = "t_s"
    if not timed or rng.random() < 0.5:
        head["rate_hz"] = 1.0 / scene.dt
    if rng.random() < 0.5:
        head["data"] = "data.csv"
        rows = np.stack(list(columns.values()), axis=1)
        np.savetxt(folder / "data.csv", rows, "%.10g", ",", header=",".join(columns), comments="")
    else:
        head["data"] = "data.npz"
        np.savez(folder / "data.npz", **columns)  # pyright: ignore[reportArgumentType]
    head |= {"twin": {"kind": scene.twin, "parameters": _beside(case, folder)}, "channels": tables}
    path = folder / "recording.toml"
    path.write_text(toml_text(head))
    return path
