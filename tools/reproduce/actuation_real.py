"""A real micromanipulator: model from the training file, judged on the test file (Aye and Ang 2018)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tools.calibrate.piezo import identify_stack
from tools.calibrate.piezo_prediction import simulate
from tools.mismatch.recording_load import load
from tools.reproduce.real_sensors import data_folder
from tools.reproduce.rows import Row

SKIP = 200
"""Samples of the first second, which holds the start."""
WINDOWS = {"without a model": (5051, 6051, 1.68), "with their inverse": (11151, 12151, 0.58)}
"""Samples of the paper's test windows, and its rms desired minus measured there, um."""
DELAY = 1
"""Samples by which the measured position is later than the desired one that it is compared with in the paper."""
STRAIGHT_LINE = "a straight line fitted to the test itself"


def _rms(e: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(e**2)))


def real_stack() -> list[Row]:
    """The paper's tracking errors computed again from its file, and what our model of the training file predicts.

    The stage cannot be driven from here, so the paper's control errors and our prediction errors are not compared.
    """
    folder = data_folder() / "piezo_micromanipulator_dbo"
    if not (folder / "train.toml").is_file():
        return []
    train, test = load(folder / "train.toml"), load(folder / "test.toml")
    fit = identify_stack(train)
    drive, z = test.inputs["command"], test.outputs["displacement"]
    with np.load(folder / "test.npz") as data:
        desired = data["desired_um"].astype(np.float64)
    source = "Aye and Ang 2018, P-885.91 micromanipulator"
    rows = [
        Row(
            source,
            f"rms desired minus measured, {name}",
            "um",
            f"samples {start} to {stop} of the test file, measured {DELAY} sample later, mean taken off; their control",
            published,
            float(np.std(desired[start:stop] - z[start + DELAY : stop + DELAY])),
            "equal",
            "recording",
            tolerance=0.005,
        )
        for name, (start, stop, published) in WINDOWS.items()
    ]
    e = (z - simulate(fit.stack, drive, 1.0 / test.dt, float(train.inputs["command"].max())))[SKIP:]
    slope, offset = np.polyfit(drive[SKIP:], z[SKIP:], 1)
    line = float(np.std(z[SKIP:] - slope * drive[SKIP:] - offset))
    condition = "model of the training file, free run over the whole test file after the first second, mean taken off"
    with_mean = f"a prediction, no control; with its mean {_rms(e):.2f}"
    return [
        *rows,
        Row(
            STRAIGHT_LINE,
            "rms prediction error",
            "um",
            condition,
            line,
            float(np.std(e)),
            "lower",
            "recording",
            why=with_mean,
        ),
        Row(
            "goal of the project",
            "rms prediction error",
            "um",
            condition,
            0.25,
            float(np.std(e)),
            "lower",
            "recording",
            why=f"{with_mean}; ten plays and a quadratic term with two samples of delay reach 0.21 to 0.25, the model "
            "takes no lag",
        ),
    ]
