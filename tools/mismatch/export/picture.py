"""Draws what a free run leaves of a recording."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from hal.arrays import Array
from tools.mismatch import units
from tools.mismatch.recording import Recording
from tools.output import save_figure


def save_run(recording: Recording, simulated: Mapping[str, Array], path: Path) -> None:
    """Draw each output as recorded and as simulated (n,), in the unit of the file, and the residual below it."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 0.8 + 3.2 * len(simulated)), dpi=100, layout="constrained")
    axes = figure.subplots(2 * len(simulated), 1, squeeze=False, sharex=True, height_ratios=[2, 1] * len(simulated))
    for k, (o, y) in enumerate(simulated.items()):
        recorded = units.convert(recording.outputs[o], recording.unit[o], recording.file_unit[o])
        above, below = axes[2 * k, 0], axes[2 * k + 1, 0]
        above.plot(recording.t, recorded, color="tab:blue", lw=0.9, label="recorded")
        above.plot(recording.t, y, color="tab:orange", lw=0.9, label="simulated")
        above.legend(loc="upper right", fontsize="small")
        above.set_title(o.replace("$", r"\$"), fontsize="small", loc="left")
        below.plot(recording.t, recorded - y, color="tab:red", lw=0.9)
        below.set_title("recorded less simulated", fontsize="small", loc="left")
        for ax in (above, below):
            ax.set_ylabel(recording.file_unit[o], fontsize="small")
            ax.margins(x=0)
            for start in recording.segments:
                ax.axvline(recording.t[start], color="0.7", lw=0.8)
    axes[-1, 0].set_xlabel("s")
    save_figure(figure, path)
