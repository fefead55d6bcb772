"""Writes recordings of the motor: ``python make.py FOLDER [VARIANT ...] [--seed N] [--rate HZ] [--seconds S]``.

With ``--seed`` every value of the motor is drawn anew. FMUs are built with the C compiler ``cc``; without one their
descriptors are left out.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import tempfile
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from motor import VARIANTS, Motor, drawn, record

CHANNELS = """
[[channels]]
column = "command_V"
role   = "input"
signal = "command"
unit   = "V"

[[channels]]
column = "angle_rad"
role   = "output"
signal = "angle"
unit   = "rad"
"""

SIMULATED = """
[[channels]]
column = "angle_simulated_rad"
role   = "input"
signal = "simulated_angle"
unit   = "rad"
"""

PARAMETERS = """
[twin.parameters]
speed_per_V = {gain}
time_constant_s = {tau}
"""

TWINS = {
    "columns": '\n[twin]\nkind = "columns"\n' + SIMULATED,
    "ode": """
[twin]
kind = "ode"

[twin.states]
angle = "rad"
speed = "rad/s"

[twin.equations]
angle = "speed"
speed = "(speed_per_V * command - speed) / time_constant_s"
"""
    + PARAMETERS
    + """
[twin.units]
speed_per_V = "rad/(s V)"
time_constant_s = "s"
""",
    "python": '\n[twin]\nkind = "motor"\n' + PARAMETERS,
    "state_space": """
[twin]
kind = "state_space"

[twin.parameters]
A = [[0.0, 1.0], [0.0, {pole}]]
B = [[0.0], [{push}]]
C = [[1.0, 0.0]]
D = [[0.0]]

[twin.parameters.states]
angle = "rad"
speed = "rad/s"
""",
    "fmu_cs": '\n[twin]\nkind = "fmu"\n' + PARAMETERS + 'path = "motor_cs.fmu"\n',
    "fmu_me": '\n[twin]\nkind = "fmu"\n' + PARAMETERS + 'path = "motor_me.fmu"\n',
}

ABOUT = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="motor" guid="motor" numberOfEventIndicators="0">
  <{kind} modelIdentifier="motor"/>
  <UnitDefinitions><Unit name="rad"/><Unit name="rad/s"/></UnitDefinitions>
  <ModelVariables>
    <ScalarVariable name="command" valueReference="0" causality="input" variability="continuous">
      <Real start="0"/></ScalarVariable>
    <ScalarVariable name="angle" valueReference="1" causality="output" variability="continuous" initial="exact">
      <Real start="0" unit="rad"/></ScalarVariable>
    <ScalarVariable name="speed" valueReference="2" causality="local" variability="continuous" initial="exact">
      <Real start="0" unit="rad/s"/></ScalarVariable>
    <ScalarVariable name="der(angle)" valueReference="3" causality="local" variability="continuous">
      <Real derivative="2"/></ScalarVariable>
    <ScalarVariable name="der(speed)" valueReference="4" causality="local" variability="continuous">
      <Real derivative="3"/></ScalarVariable>
    <ScalarVariable name="speed_per_V" valueReference="5" causality="parameter" variability="fixed" initial="exact">
      <Real start="20"/></ScalarVariable>
    <ScalarVariable name="time_constant_s" valueReference="6" causality="parameter" variability="fixed" initial="exact">
      <Real start="0.08"/></ScalarVariable>
  </ModelVariables>
  <ModelStructure>
    <Outputs><Unknown index="2"/></Outputs>
    <Derivatives><Unknown index="4"/><Unknown index="5"/></Derivatives>
  </ModelStructure>
</fmiModelDescription>
"""


def build_fmus(folder: Path) -> list[Path]:
    """The twin as FMI 2.0 FMUs for co-simulation and for model exchange; none without the compiler."""
    built: list[Path] = []
    if shutil.which("cc") is None:
        return built
    with tempfile.TemporaryDirectory() as tmp:
        library = Path(tmp) / "motor.so"
        source = Path(__file__).with_name("motor_fmu.c")
        subprocess.run(["cc", "-O2", "-shared", "-fPIC", "-o", str(library), str(source), "-lm"], check=True)
        for name, kind in (("motor_cs", "CoSimulation"), ("motor_me", "ModelExchange")):
            built.append(folder / f"{name}.fmu")
            with zipfile.ZipFile(built[-1], "w") as archive:
                archive.writestr("modelDescription.xml", ABOUT.format(kind=kind))
                archive.write(library, "binaries/linux64/motor.so")
    return built


def write(folder: Path, motor: Motor, variants: list[str]) -> None:
    """One folder per variant, with its data and every kind of twin."""
    told = {"gain": motor.told_speed_per_V, "tau": motor.told_time_constant_s}
    told |= {"pole": -1.0 / told["tau"], "push": told["gain"] / told["tau"]}
    for variant in variants or VARIANTS:
        here = folder / variant
        here.mkdir(parents=True, exist_ok=True)
        columns = record(motor, variant)
        np.savetxt(
            here / "data.csv",
            np.column_stack([*columns.values()]),
            fmt="%.7g",
            delimiter=",",
            header=",".join(columns),
            comments="",
        )
        fmus = build_fmus(here)
        head = f'format  = 1\ntitle   = "motor, {variant.replace("_", " ")}"\n'
        head += f'data    = "data.csv"\nrate_hz = {motor.rate_hz}\n'
        for name, twin in TWINS.items():
            if fmus or not name.startswith("fmu"):
                (here / f"{name}.toml").write_text(head + twin.format(**told) + CHANNELS)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("variants", nargs="*")
    parser.add_argument("--seed", type=int)
    parser.add_argument("--rate", type=float, default=100.0)
    parser.add_argument("--seconds", type=float, default=20.0)
    said = parser.parse_args()
    first = Motor() if said.seed is None else drawn(said.seed)
    write(said.folder, replace(first, rate_hz=said.rate, seconds=said.seconds), said.variants)
