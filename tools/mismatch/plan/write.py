"""Writes a plan to files: csv, npz, a program of the bench, and a picture."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tools.mismatch import units
from tools.mismatch.plan.design import Plan
from tools.mismatch.plan.models import Rival, refit
from tools.mismatch.plan.situation import Situation, simulated, with_outputs
from tools.mismatch.recording import Array
from tools.mismatch.simulate import Model
from tools.mismatch.twins.make import make
from tools.output import save_figure, write_bytes_atomic, write_text_atomic

CSV, NPZ, PROGRAM, PICTURE = "input.csv", "input.npz", "program.toml", "plan.png"
FILES = (CSV, NPZ, PROGRAM, PICTURE)
PROGRAM_RATE_HZ = 1000.0
"""Rate of a program of the bench, which is its tick rate. A plan at another rate is interpolated linearly."""


def columns(plan: Plan, where: Situation) -> dict[str, Array]:
    """Return time and inputs in the units and under the names of the data file."""
    rec = where.template
    n = next(iter(plan.waves.values())).size
    out: dict[str, Array] = {"t_s": np.asarray(np.arange(n) * plan.dt, np.float64)}
    for s, x in plan.waves.items():
        out[rec.column.get(s, s)] = units.convert(x, rec.unit[s], rec.file_unit[s])
    return out


def write_plan(plan: Plan, where: Situation, folder: Path, stacks: Sequence[int] = ()) -> list[Path]:
    """Write ``input.csv``, ``input.npz`` and, for ``stacks`` of a bench, ``program.toml``; returns the files."""
    folder.mkdir(parents=True, exist_ok=True)
    table = columns(plan, where)
    rows = [",".join(table)] + [
        ",".join(f"{v:.10g}" for v in row) for row in np.column_stack([*table.values()]).tolist()
    ]
    write_text_atomic(folder / CSV, "\n".join(rows) + "\n")
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **table)  # pyright: ignore[reportArgumentType]
    write_bytes_atomic(folder / NPZ, buffer.getvalue())
    out = [folder / CSV, folder / NPZ]
    if stacks:
        write_text_atomic(folder / PROGRAM, program(plan, stacks))
        out.append(folder / PROGRAM)
    return out


def program(plan: Plan, stacks: Sequence[int]) -> str:
    """Write the inputs as a program for ``micron run --manual``: volts of ``stacks`` (1 to 3), tick by tick.

    One input moves all of them, several move one each.
    """
    lists = ["[\n" + _ticks(wave, plan.dt) + "\n]" for wave in plan.waves.values()]
    volts = lists[0] if len(lists) == 1 else "[" + ", ".join(lists) + "]"
    return (
        "# Written by micron mismatch plan. Run it: micron run --manual program.toml\n"
        f"format = 1\nrate_hz = {PROGRAM_RATE_HZ}\nstacks = {list(stacks)}\nvolts = {volts}\n"
    )


def _ticks(wave: Array, dt: float) -> str:
    n = round(wave.size * dt * PROGRAM_RATE_HZ)
    volts = np.interp(np.arange(n) / PROGRAM_RATE_HZ, np.arange(wave.size) * dt, wave)
    return "\n".join("  " + ", ".join(f"{v:.4f}" for v in volts[i : i + 12]) + "," for i in range(0, n, 12))


def draw_plan(plan: Plan, where: Situation, rivals: Sequence[Rival], sigma: dict[str, float], path: Path) -> None:
    """Draw the planned inputs, and the difference of each re-fitted rival from the named model, in noise rms."""
    from matplotlib.figure import Figure

    course = where.course(plan.waves)
    twin = make(course)
    truth = with_outputs(course, simulated(course, Model(twin, rivals[0].placed), rivals[0].theta))
    left = [refit(truth, r, sigma).residual for r in rivals[1:]]
    t = course.t
    figure = Figure(figsize=(9.0, 2.2 * (len(plan.waves) + len(sigma))), layout="constrained")
    axes: Any = figure.subplots(len(plan.waves) + len(sigma), 1, sharex=True, squeeze=False)[:, 0]
    for ax, (s, x) in zip(axes, plan.waves.items(), strict=False):
        ax.plot(t, x, lw=0.8)
        ax.set_ylabel(f"{s} ({where.template.unit[s]})")
        ax.set_title(f"planned input: {plan.description}", loc="left", fontsize=10)
    for ax, o in zip(axes[len(plan.waves) :], sigma, strict=False):
        for r, rest in zip(rivals[1:], left, strict=True):
            ax.plot(t, rest[o] / sigma[o], lw=0.7, label=f"{r.name}, re-fitted")
        ax.set_ylabel(f"{o} (noise rms)")
        ax.set_title(f"what each rival leaves of {rivals[0].name}", loc="left", fontsize=10)
        ax.legend(loc="upper right", fontsize=8)
    axes[-1].set_xlabel("time (s)")
    save_figure(figure, path, dpi=110)
