"""Writes the recordings of the motor: ``python make.py FOLDER [VARIANT ...]``."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from motor import RATE_HZ, SPEED_PER_V, TIME_CONSTANT_S, VARIANTS, record

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

HEAD = f"""format  = 1
title   = "motor, %s"
data    = "data.csv"
rate_hz = {RATE_HZ}
"""

SIMULATED = """
[[channels]]
column = "angle_simulated_rad"
role   = "input"
signal = "simulated_angle"
unit   = "rad"
"""

TWINS = {
    "columns": """
[twin]
kind = "columns"
"""
    + SIMULATED,
    "ode": f"""
[twin]
kind = "ode"

[twin.states]
angle = "rad"
speed = "rad/s"

[twin.equations]
angle = "speed"
speed = "(speed_per_V * command - speed) / time_constant_s"

[twin.parameters]
speed_per_V = {SPEED_PER_V}
time_constant_s = {TIME_CONSTANT_S}

[twin.units]
speed_per_V = "rad/(s V)"
time_constant_s = "s"
""",
    "python": f"""
[twin]
kind = "motor"

[twin.parameters]
speed_per_V = {SPEED_PER_V}
time_constant_s = {TIME_CONSTANT_S}
""",
}


def main(folder: Path, variants: list[str]) -> None:
    for variant in variants or VARIANTS:
        here = folder / variant
        here.mkdir(parents=True, exist_ok=True)
        columns = record(variant)
        np.savetxt(
            here / "data.csv",
            np.column_stack([*columns.values()]),
            fmt="%.7g",
            delimiter=",",
            header=",".join(columns),
            comments="",
        )
        for name, twin in TWINS.items():
            (here / f"{name}.toml").write_text(HEAD % variant.replace("_", " ") + twin + CHANNELS)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
