"""Prediction error against horizon, one line a method, the limits dashed; what is left, in time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from firmware_py.tremor.config import Method, TremorConfig
from tools.output import save_figure
from tools.research.tremor.cases import RATE_HZ, Case
from tools.research.tremor.evaluate import LIMITS, ORACLE, OTHERS, UNSEEN, Summary, run_case, with_horizon
from tools.research.tremor.scores import residual

LOOP_MS = 2
SHOWN_S = 8.0  # from the start: how a method learns is part of it


def save_horizon_picture(lines: Sequence[Summary], path: Path) -> None:
    """Write a PNG, one panel a group; the folder is made if it is not there."""
    from matplotlib.figure import Figure

    groups = list(dict.fromkeys(line.group for line in lines))
    figure = Figure(figsize=(5.0 * len(groups), 4.2), dpi=120, layout="constrained")
    for n, group in enumerate(groups):
        axes = figure.add_subplot(1, len(groups), n + 1)
        for method in dict.fromkeys(line.method for line in lines if line.group == group):
            own = [line for line in lines if line.group == group and line.method == method]
            limit = method in LIMITS
            axes.plot(
                [line.horizon_ms for line in own],
                [line.lifted_percent for line in own],
                label=method,
                color="black" if limit else None,
                linestyle={OTHERS: "--", ORACLE: ":", UNSEEN: "-."}.get(method, "-"),
                marker=None if limit else "o",
                markersize=3,
            )
        axes.set(title=group, xlabel="horizon (ms)", ylabel="left of the motion (% rms)", ylim=(0, 120))
        axes.grid(visible=True, lw=0.3)
        axes.legend(fontsize="x-small")
    save_figure(figure, path)


def save_series_picture(case: Case, methods: Sequence[Method], horizon_ms: int, path: Path) -> None:
    """Write a PNG: the axis that moves most, above the motion, below what each method leaves of it."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 1.6 * (1 + len(methods))), dpi=120, layout="constrained")
    ticks = round(horizon_ms * 1e-3 * RATE_HZ)
    rows = slice(0, round(SHOWN_S * RATE_HZ))
    axis = int(np.argmax(np.var(case.truth, axis=0)))
    config = TremorConfig()
    panels: list[tuple[str, np.ndarray]] = [(f"{case.name}: involuntary motion", case.truth[rows, axis])]
    for method in methods:
        if method == "kalman" and case.sees == "displacement":
            continue
        ahead, _, _ = run_case(case, with_horizon(config, case, method, horizon_ms))
        panels.append((f"left by {method}, {horizon_ms} ms ahead", residual(case, ahead, ticks)[rows, axis]))
    reach = 1.05e6 * float(np.max(np.abs(panels[0][1])))
    for n, (title, values) in enumerate(panels):
        axes = figure.add_subplot(len(panels), 1, n + 1)
        axes.plot(np.arange(len(values)) / RATE_HZ, 1e6 * values, lw=0.7, color="black" if n == 0 else "tab:red")
        axes.set_title(title, loc="left", fontsize="small")
        axes.set(ylim=(-reach, reach), xlim=(0.0, SHOWN_S), ylabel="um")
        axes.grid(visible=True, lw=0.3)
        if n < len(panels) - 1:
            axes.tick_params(labelbottom=False)
        else:
            axes.set_xlabel("time (s)")
    save_figure(figure, path)
