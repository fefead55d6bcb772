"""Draws the Allan deviation: estimates with their intervals, the fitted model, one colour a column."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from tools.noise.allan import AllanCurve, NoiseModel
from tools.output import save_figure


def save_allan_picture(curves: Mapping[str, tuple[AllanCurve, NoiseModel]], path: Path) -> None:
    """Write a PNG; the folder is made if it is not there."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 5.0), dpi=120, layout="constrained")
    axes = figure.add_subplot()
    for name, (curve, model) in curves.items():
        reach = np.abs(np.stack([curve.low, curve.high]) - curve.deviation)
        points = axes.errorbar(curve.tau_s, curve.deviation, yerr=reach, fmt="o", ms=3, lw=0.8, capsize=2, label=name)
        axes.plot(curve.tau_s, np.sqrt(model.variance(curve.tau_s)), lw=1.0, color=points[0].get_color())
    axes.set(xscale="log", yscale="log", xlabel="averaging time (s)", ylabel="Allan deviation (unit)")
    axes.grid(visible=True, which="both", lw=0.3)
    axes.legend(fontsize="small")
    save_figure(figure, path)
