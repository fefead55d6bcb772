"""A corrected twin of every kind, loaded again and run freely over the whole recording, gives the report's residual."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hal.arrays import Array
from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_model.made import recording
from tests.unit.mismatch_model.test_cascade import circuit, in_two
from tools.mismatch.apply import corrected_twin
from tools.mismatch.export.run import simulate_file
from tools.mismatch.export.write import write_twin
from tools.mismatch.infer import diagnose
from tools.mismatch.recording import Recording
from tools.mismatch.recording_load import load
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_view import View
from tools.mismatch.twins.make import make
from tools.toml_text import toml_text

N, DT = 1500, 0.01
FILE_UNITS = {"um": "nm", "m": "mm", "V": "mV", "rad": "deg"}
"""Files are in other units than the twins."""


def wave(k: int = 0) -> Array:
    rng, t = np.random.default_rng(k), np.arange(N) * DT
    return sum((np.sin(2 * np.pi * rng.uniform(0.1, 2.0) * t + rng.uniform(0, 6.28)) for _ in range(5)), np.zeros(N))


def as_given(
    kind: str, inputs: dict[str, Array], outputs: dict[str, str], given: dict[str, Any], units: str
) -> Recording:
    """A recording whose outputs are what the twin does as given; ``outputs``: unit by name."""
    stand_in = {o: wave(9) for o in outputs}
    rec = recording(kind, DT, inputs, stand_in, {**dict.fromkeys(inputs, units), **outputs}, given)
    model = Model(make(rec))
    return replace(rec, outputs=dict(model.simulate(View.whole(rec), model.start(rec))))


def limited(rec: Recording) -> Recording:
    """Readings that end below the largest ones, with noise."""
    rng = np.random.default_rng(3)

    def one(y: Array) -> Array:
        lo, hi = np.quantile(y, [0.1, 0.93])
        return np.clip(y, lo, hi) + rng.normal(0, 2e-3 * np.std(y), y.size)

    return replace(rec, outputs={o: one(y) for o, y in rec.outputs.items()})


def weak(kind: str, drive: str, wanted: Array, output: dict[str, str], given: dict[str, Any], unit: str) -> Recording:
    """A drive that cannot give as much as was wanted of it, with noise at the output."""
    lo, hi = np.quantile(wanted, [0.08, 0.88])
    rec = as_given(kind, {drive: np.clip(wanted, lo, hi)}, output, given, unit)
    rng = np.random.default_rng(3)
    noisy = {o: y + rng.normal(0, 2e-3 * np.std(y), y.size) for o, y in rec.outputs.items()}
    return replace(rec, inputs={drive: wanted}, outputs=noisy)


def piezo() -> tuple[Recording, str]:
    given = {"gain_um_per_V": 0.125, "offset_um": -1.0}
    return limited(
        as_given("piezo_stack", {"command": 50 + 9 * wave()}, {"displacement": "um"}, given, "V")
    ), "saturation"


def axes(kind: str, prefix: str, unit: str, given: dict[str, Any]) -> tuple[Recording, str]:
    inputs = {f"{prefix}_{a}": wave(i) for i, a in enumerate("xyz")}
    return limited(as_given(kind, inputs, {f"voltage_{a}": "V" for a in "xyz"}, given, unit)), "saturation"


def cluster() -> tuple[Recording, str]:
    inputs = {f"specific_force_{a}": wave(i) for i, a in enumerate("xyz")} | {"angular_rate_z": 0.1 * wave(4)}
    outputs = {f"accel_{i}{a}": "m/s^2" for i in (1, 2) for a in "xy"}
    given = {"positions_m": {"1": [0.1, 0.2, 0.0], "2": [-0.2, 0.0, 0.1]}}
    rec = as_given("accelerometer_cluster", inputs, outputs, given, "m/s^2")
    rec = replace(rec, unit={**rec.unit, "angular_rate_z": "rad/s"})
    return limited(rec), "saturation"


def axis() -> tuple[Recording, str]:
    given = {"mass": 2.0, "damping": 9.0, "stiffness": 300.0}
    return weak("mechanical_axis", "force", 20 * wave(), {"position": "m"}, given, "N"), "saturation"


def warm_drive() -> tuple[Recording, str]:
    """An axis whose drive has an offset that settles."""
    given = {"mass": 2.0, "damping": 9.0, "stiffness": 300.0}
    force = 20 * wave()
    rec = as_given(
        "mechanical_axis", {"force": force + 15 * np.exp(-np.arange(N) * DT / 4)}, {"position": "m"}, given, "N"
    )
    noisy = {o: y + np.random.default_rng(3).normal(0, 2e-3 * np.std(y), N) for o, y in rec.outputs.items()}
    return replace(rec, inputs={"force": force}, outputs=noisy), "thermal_drift"


def folded() -> tuple[Recording, str]:
    """A sensor that reads the magnitude to the power of 1.6, behind a run that begins at rest."""
    given = {"A": [[0.0, 1.0], [-90.0, -8.0]], "B": [[0.0], [1.0]], "C": [[90.0, 0.0]], "x0": [0.0, 0.0]}
    rec = as_given("state_space", {"u": wave()}, {"y": "V"}, given, "V")
    noise = np.random.default_rng(3).normal(0, 2e-3, N)
    return replace(rec, outputs={"y": 1.3 * np.abs(rec.outputs["y"]) ** 1.6 + noise}), "static_nonlinearity"


def equations() -> tuple[Recording, str]:
    given: dict[str, Any] = {"states": {"angle": "rad"}, "gain": 2.0, "lag": 0.2, "hard": 0.3}
    given["equations"] = {"angle": "(gain * volts - angle - hard * angle**3) / lag"}
    return weak("ode", "volts", wave(), {"angle": "rad"}, given, "V"), "saturation"


def space(**more: Any) -> tuple[Recording, str]:
    given = {"A": [[0.0, 1.0], [-900.0, -22.0]], "B": [[0.0], [1.0]], "C": [[900.0, 0.0]], **more}
    return limited(as_given("state_space", {"u": wave()}, {"y": "V"}, given, "V")), "saturation"


def cascade() -> tuple[Recording, str]:
    u, y = circuit(4000, 0.4)
    rec = in_two(u, y + 1e-3 * np.random.default_rng(1).standard_normal(y.size))
    return rec, "one_sided_conduction"


def simulated_columns() -> tuple[Recording, str]:
    given = {"offset": 0.0, "scale": 1.0}
    rec, name = limited(as_given("columns", {"simulated_level": wave()}, {"level": "V"}, given, "V")), "saturation"
    return rec, name


MADE: dict[str, Callable[[], tuple[Recording, str]]] = {
    "piezo_stack": piezo,
    "accelerometer": lambda: axes("accelerometer", "specific_force", "g", {"bias_V": 2.5, "scale_V_per_g": 1.0}),
    "magnetometer": lambda: axes("magnetometer", "field", "uT", {"bias_V": 2.5, "scale_V_per_uT": 0.02}),
    "accelerometer_cluster": cluster,
    "mechanical_axis": axis,
    "mechanical_axis with a warm drive": warm_drive,
    "state_space": space,
    "state_space with a folded sign": folded,
    "state_space with names": lambda: space(states={"place": "m", "speed": "m/s"}),
    "state_space in two": cascade,
    "ode": equations,
    "columns": simulated_columns,
}


def written(folder: Path, rec: Recording) -> Path:
    """The recording as a folder, in units of the file that are not the twin's."""
    folder.mkdir()
    channels, columns = [], {}
    for role, part in (("input", rec.inputs), ("output", rec.outputs)):
        for s, x in part.items():
            unit = rec.unit[s]
            to = FILE_UNITS.get(unit, unit) if role == "output" or s.startswith("simulated") else unit
            factor = 1.0 if to == unit else float(np.degrees(1.0)) if to == "deg" else 1e3
            columns[s] = factor * x
            channels.append({"column": s, "role": role, "signal": s, "unit": to})
    np.savez(folder / "data.npz", **columns)
    table = {"format": 1, "data": "data.npz", "rate_hz": 1 / rec.dt}
    table["twin"] = {"kind": rec.twin.kind, "parameters": dict(rec.twin.parameters)}
    (folder / "recording.toml").write_text(toml_text({**table, "channels": channels}))
    return folder


LONG = ("state_space with names",)


@pytest.mark.parametrize("kind", [pytest.param(k, marks=pytest.mark.slow) if k in LONG else k for k in MADE])
def test_the_residual_of_the_report(kind: str, tmp_path: Path) -> None:
    """On the report's held-out samples, within 2 %: a diagnosis may set the start state from fewer samples than a run
    of the whole.
    """
    made, name = MADE[kind]()
    folder = written(tmp_path / "rec", made)
    rec = load(folder)
    report = json.loads(json.dumps(diagnose(rec, jobs=1, effects=[EFFECTS[name]]).to_json()))
    assert {p["name"] for p in report["physics"]} == {name}
    twin = corrected_twin(folder, report)
    data = np.load(folder / "data.npz")
    table = {}
    for form in ("toml", "py", "csv"):
        out = tmp_path / f"twin.{form}"
        write_twin(twin, report, out)
        if form == "csv":
            table = np.genfromtxt(out, delimiter=",", names=True)
            found = {o: table[f"{o}_simulated"] for o in rec.outputs}
        else:
            found = simulate_file(out, folder)
        for o in rec.outputs:
            away = data[o] - found[o]
            held = np.concatenate([away[a:b] for a, b in report["fit"]["held_out_spans"]])
            scale = np.ptp(rec.outputs[o]) / np.ptp(data[o])
            rms = scale * float(np.sqrt(np.mean(held**2)))
            assert rms == pytest.approx(report["fit"]["fitted_rms"][o], rel=0.02), (form, o)
