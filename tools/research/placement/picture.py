"""The instrument with its accelerometers, seen from the side and from the back."""

from __future__ import annotations

from pathlib import Path

from tools.output import save_figure
from tools.research.placement.configurations import Placement
from tools.research.placement.space import Space


def save_placement_picture(placement: Placement, space: Space, path: Path) -> None:
    """Write a PNG; the folder is made if it is not there."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    figure = Figure(figsize=(10.0, 4.5), dpi=120, layout="constrained")
    side, back = figure.subplots(1, 2, width_ratios=[2.0, 1.0])
    for axes, (a, b), labels in (
        (side, (2, 0), ("z, toward the tip (mm)", "x (mm)")),
        (back, (0, 1), ("x (mm)", "y (mm)")),
    ):
        for box in space.box:
            low, high = box.low_mm, box.high_mm
            size = high[a] - low[a], high[b] - low[b]
            axes.add_patch(Rectangle((low[a], low[b]), *size, fill=False, lw=1.0, ls="--", color="0.5"))
        for i, (r, s) in enumerate(zip(placement.positions * 1e3, placement.axes, strict=True)):
            axes.annotate(
                "",
                (r[a] + 9.0 * s[a], r[b] + 9.0 * s[b]),
                (r[a], r[b]),
                arrowprops={"arrowstyle": "->", "color": f"C{i}"},
            )
            axes.plot(r[a], r[b], "o", ms=4, color=f"C{i}", label=f"axis {i + 1}" if axes is side else None)
            # an arrow does not count for the limits of the picture
            axes.plot(r[a] + 10.0 * s[a], r[b] + 10.0 * s[b], ".", ms=0.0)
        axes.plot(space.tip_mm[a], space.tip_mm[b], "k^", ms=6)
        axes.set(xlabel=labels[0], ylabel=labels[1])
        axes.set_aspect("equal", adjustable="datalim")
    side.legend(fontsize="x-small", ncols=3)
    save_figure(figure, path)
