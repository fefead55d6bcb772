"""Configurations side by side: rate and tip displacement in the tremor band."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tools.output import save_figure
from tools.research.placement.analysis import BAND_HZ, Analysis


def save_analysis_picture(found: Sequence[Analysis], path: Path) -> None:
    """Write a PNG; the folder is made if it is not there."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.6), dpi=120, layout="constrained")
    panels = figure.subplots(1, 3)
    rows = (
        ("acceleration of the tip (mm/s$^2$)", [1e3 * a.force_tip for a in found]),
        (f"rate, {BAND_HZ[0]:g} to {BAND_HZ[1]:g} Hz (deg/s)", [np.degrees(a.rate_band) for a in found]),
        (f"tip displacement, {BAND_HZ[0]:g} to {BAND_HZ[1]:g} Hz (um)", [1e6 * a.tip_band_m for a in found]),
    )
    width = 0.8 / len(found)
    for axes, (title, values) in zip(panels, rows, strict=True):
        for k, (analysis, value) in enumerate(zip(found, values, strict=True)):
            axes.bar(np.arange(3) + (k - 0.5 * (len(found) - 1)) * width, value, width, label=analysis.name)
        axes.set_xticks(range(3), ["x", "y", "z"])
        axes.set_yscale("log")
        axes.set_title(title, fontsize="small")
        axes.grid(visible=True, axis="y", lw=0.4)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, fontsize="x-small", ncols=min(4, len(found)), loc="outside lower center")
    figure.suptitle("rms error by body axis, from the sensors' noise alone", fontsize="medium")
    save_figure(figure, path)
