"""A real micromanipulator: model from the training file, judged on the test file (Aye and Ang 2018)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tools.calibrate.piezo import identify_stack
from tools.calibrate.piezo_prediction import simulate
from tools.mismatch.recording_load import load
from tools.reproduce.real_sensors import data_folder
from tools.reproduce.rows import Row

WINDOWS = {"uncompensated": (5051, 6051, 1.68), "compensated": (11151, 12151, 0.58)}
"""Samples of the paper's test windows, and its rms desired minus measured there, um."""


def _rms(e: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(e**2)))


def real_stack() -> list[Row]:
    """Return what the model cannot predict is what its inverse would leave; the stage cannot be driven from here."""
    folder = data_folder() / "piezo_micromanipulator_dbo"
    if not (folder / "train.toml").is_file():
        return []
    train, test = load(folder / "train.toml"), load(folder / "test.toml")
    fit = identify_stack(train)
    drive = test.inputs["command"]
    z = test.outputs["displacement"]
    e = z - simulate(fit.stack, drive, 1.0 / test.dt, float(train.inputs["command"].max()))
    source = "Aye and Ang 2018, P-885.91 micromanipulator"
    rows = []
    for name, (start, stop, published) in WINDOWS.items():
        rows.append(
            Row(
                source,
                f"rms prediction error, the paper's {name} window",
                "um",
                "trained on the constant-amplitude file, mean of the window taken off as in the paper",
                published,
                float(np.std(e[start:stop])),
                "lower",
                "recording",
                why="published: desired minus measured "
                + ("without a model" if published > 1.0 else "with their inverse")
                + f"; with its mean ours is {_rms(e[start:stop]):.2f}",
            )
        )
    rows.append(
        Row(
            source,
            "rms prediction error, whole test file",
            "um",
            "after the first second, mean taken off",
            0.58,
            float(np.std(e[200:])),
            "lower",
            "recording",
            why=f"beside the published error with their inverse; with its mean {_rms(e[200:]):.2f}",
        )
    )
    return rows
