"""Draws figures for notebooks: signals over time, a diagnosis as courses and residuals."""

from __future__ import annotations

import io
from collections.abc import Mapping
from types import MappingProxyType

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from tools.errors import InputError
from tools.mismatch.engine.report import Report
from tools.mismatch.recording import Array
from tools.mismatch.report.series import envelope_line, runs

WIDTH_IN = 9.0
ROW_IN = 1.6
POINTS = 2000
COLOURS = MappingProxyType({"as given": "tab:grey", "recalibrated": "tab:orange", "with physics": "tab:blue"})


class NotebookFigure(Figure):
    """Shows itself in a notebook with any backend and without pyplot."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        FigureCanvasAgg(self).print_png(buffer)
        return buffer.getvalue()


def plot_signals(t: Array, signals: Mapping[str, Array], units: Mapping[str, str]) -> Figure:
    """Draw each signal (n,) over time (n,) in a row of its own."""
    figure = NotebookFigure(figsize=(WIDTH_IN, ROW_IN * len(signals) + 0.4), layout="constrained")
    rows = figure.subplots(len(signals), sharex=True, squeeze=False)[:, 0]
    for axes, (name, values) in zip(rows, signals.items(), strict=True):
        axes.plot(*envelope_line(t, values, POINTS), lw=0.8)
        axes.set_ylabel(f"{name} ({units[name]})" if units.get(name) else name)
        axes.grid(alpha=0.3)
    rows[-1].set_xlabel("time (s)")
    return figure


def plot_report(report: Report, output: str | None = None) -> Figure:
    """Draw an output of a report: the courses, and the residuals below them. Raises ``InputError``."""
    p, fit = report.pictures, report.fit
    if p is None:
        raise InputError(
            "this report carries no courses to draw, as one that was read from JSON; diagnose the recording again"
        )
    order = sorted(fit.unit, key=lambda o: -fit.recalibrated_rms[o] / max(fit.noise_floor_rms[o], 1e-300))
    chosen = output or order[0]
    if chosen not in fit.unit:
        raise InputError(f"no output '{chosen}'; there are: {', '.join(fit.unit)}")
    unit, measured = fit.unit[chosen], p.measured[chosen]
    courses = {"as given": p.as_given[chosen], "recalibrated": p.recalibrated[chosen]}
    if report.physics:
        courses["with physics"] = p.fitted[chosen]
    figure = NotebookFigure(figsize=(WIDTH_IN, 4.8), layout="constrained")
    above, below = figure.subplots(2, sharex=True)
    above.plot(*envelope_line(p.t, measured, POINTS), color="black", lw=1.0, label="measured")
    for name, course in courses.items():
        style = {"lw": 0.8, "color": COLOURS[name]}
        above.plot(*envelope_line(p.t, course, POINTS), label=name, **style)
        if name != "as given":
            below.plot(*envelope_line(p.t, measured - course, POINTS), label=f"measured less {name}", **style)
    for axes in (above, below):
        for k, (start, stop) in enumerate(runs(p.held_out, p.t)):
            label = "held out" if k == 0 and axes is below else None
            axes.axvspan(p.t[start], p.t[stop - 1], color="grey", alpha=0.15, lw=0, label=label)
        axes.grid(alpha=0.3)
        axes.legend(loc="upper right", fontsize=8, ncols=4)
    above.set_ylabel(f"{chosen} ({unit})")
    below.set_ylabel(f"residual ({unit})")
    below.set_xlabel("time (s)")
    above.set_title(report.verdict.replace("_", " "), loc="left", fontsize=10)
    return figure
