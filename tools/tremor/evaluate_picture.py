"""Prediction error against horizon, one line a method, the limits dashed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from tools.tremor.evaluate import ORACLE, OTHERS, Summary


def save_horizon_picture(lines: Sequence[Summary], path: Path) -> None:
    """Write a PNG, one panel a group; the folder is made if it is not there."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    groups = list(dict.fromkeys(line.group for line in lines))
    figure = Figure(figsize=(5.0 * len(groups), 4.2), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    for n, group in enumerate(groups):
        axes = figure.add_subplot(1, len(groups), n + 1)
        for method in dict.fromkeys(line.method for line in lines if line.group == group):
            own = [line for line in lines if line.group == group and line.method == method]
            limit = method in (OTHERS, ORACLE)
            axes.plot(
                [line.horizon_ms for line in own],
                [line.lifted_percent for line in own],
                label=method,
                color="black" if limit else None,
                linestyle={OTHERS: "--", ORACLE: ":"}.get(method, "-"),
                marker=None if limit else "o",
                markersize=3,
            )
        axes.set(title=group, xlabel="horizon (ms)", ylabel="left of the motion (% rms)", ylim=(0, 120))
        axes.grid(visible=True, lw=0.3)
        axes.legend(fontsize="x-small")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
