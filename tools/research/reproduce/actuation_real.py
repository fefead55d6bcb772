"""A real micromanipulator: model from the training file, judged on the test file (Aye and Ang 2018).

Two different things are in these rows. A prediction is what our model of the training file says of the test file. The
stage cannot be driven from here, so control is simulated: our inverse drives two plants of other model classes, which
were fitted to the test file (``stack_plants``), over the path that the authors asked for.
"""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from hal.arrays import Array
from tools.calibrate.piezo import identify_stack
from tools.calibrate.piezo_fit import PiezoFit
from tools.calibrate.piezo_prediction import command, simulate
from tools.mismatch.recording import Recording
from tools.mismatch.recording_load import load
from tools.numbers import rms
from tools.research.reproduce.real_sensors import data_folder
from tools.research.reproduce.rows import Row
from tools.research.reproduce.stack_plants import Plant, narx, preisach

SKIP = 200
"""Samples of the first second, which holds the start."""
WINDOWS = {"without a model": (5051, 6051, 1.68), "with their inverse": (11151, 12151, 0.58)}
"""Samples of the paper's test windows, and its rms desired minus measured there, um."""
DELAY = 1
"""Samples by which the measured position is later than the desired one that it is compared with in the paper."""
STRAIGHT_LINE = "a straight line fitted to the test itself"
PATH_UM, PATH_HZ, RISE_S = 20.0, 1.0, 5.0
"""Amplitude and frequency of the authors' path; it rises from rest within this time."""
GOAL_UM = 0.25
SCORED_S = (10.0, 15.0)


def prediction(fit: PiezoFit, drive: Array, dt: float, high_V: float) -> Array:
    """Displacement um (n,) that the model gives a drive V (n,), its lag included."""
    x = simulate(fit.stack, drive, 1.0 / dt, high_V)
    return x[0] + np.asarray(lfilter(fit.dynamics.response(dt), [1.0], x - x[0]), dtype=np.float64)


def tracking(fit: PiezoFit, plant: Plant, dt: float, preview_s: float) -> float:
    """rms um of the authors' path minus the plant's displacement one sample later, mean taken off, under our inverse.

    The inverse gets the path ``preview_s`` ahead; there is no feedback.
    """
    t: Array = np.arange(round((SCORED_S[1] + 1.0) / dt), dtype=np.float64) * dt

    def path(at: Array) -> Array:
        return PATH_UM * np.clip(at / RISE_S, 0.0, 1.0) * np.sin(2.0 * np.pi * PATH_HZ * at)

    asked = command(
        fit.stack,
        path(t + preview_s),
        neutral_V=fit.neutral_V,
        tick_hz=1.0 / dt,
        low_V=0.0,
        high_V=fit.high_V,
        slew_V_per_s=1e6,
    )
    z = plant.run(asked.drive_V)
    start, stop = (round(s / dt) for s in SCORED_S)
    return float(np.std(path(t)[start:stop] - z[start + DELAY : stop + DELAY]))


def real_stack() -> list[Row]:
    """The paper's errors of control recomputed from its file, our prediction of that file, our simulated control."""
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
    e = (z - prediction(fit, drive, test.dt, float(train.inputs["command"].max())))[SKIP:]
    slope, offset = np.polyfit(drive[SKIP:], z[SKIP:], 1)
    line = float(np.std(z[SKIP:] - slope * drive[SKIP:] - offset))
    condition = "PREDICTION: model of the training file, free run over the test file after the first second, mean off"
    with_mean = f"a prediction, no control; with its mean {rms(e):.2f}; the test file was in view of the development"
    predicted = [
        Row(
            source,
            "rms prediction error",
            "um",
            condition,
            limit,
            float(np.std(e)),
            "lower",
            "recording",
            why=with_mean,
        )
        for source, limit in ((STRAIGHT_LINE, line), ("goal of the project", GOAL_UM))
    ]
    return [*rows, *predicted, *_control(fit, test)]


def _control(fit: PiezoFit, test: Recording) -> list[Row]:
    drive, z = test.inputs["command"], test.outputs["displacement"]
    rows: list[Row] = []
    for plant in (preisach(drive, z), narx(drive, z)):
        ours, blind = (tracking(fit, plant, test.dt, preview_s) for preview_s in (fit.lag_s, 0.0))
        rows.append(
            Row(
                "Aye and Ang 2018, their inverse on the stage",
                f"rms desired minus simulated, our inverse on a {plant.name} plant",
                "um",
                f"CONTROL, simulated: plant fitted to the test file ({plant.rms_um:.2f} um), model of the training "
                f"file, path known {1e3 * fit.lag_s:.0f} ms ahead, {DELAY} sample later, mean off",
                WINDOWS["with their inverse"][2],
                ours,
                "lower",
                "emulated",
                why=f"without knowing the path ahead {blind:.2f}",
            )
        )
    return rows
