"""Draws a sensor in one picture: accelerations and rates in time, and against temperature where that changed."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tools.imu.series import AXES, Array, Series
from tools.output import save_figure

POINTS = 4000
COLOURS = ("#0072b2", "#d55e00", "#009e73")


def save_imu_picture(series: Series, path: Path) -> None:
    """Write a PNG; the folder is made if it is not there. Means are taken off, long series are thinned by envelope."""
    from matplotlib.figure import Figure

    warm = series.temperature_C if series.temperature_C is not None and np.ptp(series.temperature_C) >= 5.0 else None
    kinds = [("acceleration - mean (mg)", 1e3 * series.accel_g)]
    if series.gyro_dps is not None:
        kinds.append(("rate - mean (deg/s)", series.gyro_dps))
    figure = Figure(figsize=(9.0, 3.0 * len(kinds)), dpi=120, layout="constrained")
    axes = figure.subplots(len(kinds), 1 if warm is None else 2, squeeze=False)
    for row, (label, data) in enumerate(kinds):
        centred = data - data.mean(axis=0)
        for i, axis in enumerate(AXES):
            t, low, high = _envelope(centred[:, i], series.rate_hz)
            axes[row, 0].fill_between(t, low, high, color=COLOURS[i], alpha=0.5, lw=0.3, label=axis)
            if warm is not None:
                blocks = max(4, int(series.seconds))
                x = [part.mean() for part in np.array_split(warm, blocks)]
                y = [part.mean() for part in np.array_split(centred[:, i], blocks)]
                axes[row, 1].plot(x, y, ".", ms=2, color=COLOURS[i], label=axis)
        axes[row, 0].set(xlabel="time (s)", ylabel=label)
        axes[row, 0].legend(fontsize="small", ncols=3)
        if warm is not None:
            axes[row, 1].set(xlabel="temperature of the chip (degC)", ylabel=label)
    figure.suptitle(f"{series.name}, {series.rate_hz:g} Hz", fontsize="medium")
    save_figure(figure, path)


def _envelope(value: Array, rate_hz: float) -> tuple[Array, Array, Array]:
    """Time, lowest and highest of blocks, so that no spike is lost."""
    step = max(1, len(value) // POINTS)
    n = len(value) // step
    blocks = value[: n * step].reshape(n, step)
    return np.arange(n) * step / rate_hz, blocks.min(axis=1), blocks.max(axis=1)
