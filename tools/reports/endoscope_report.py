"""Reports a run of an endoscope bench: samples, attitude against the emulated truth, experiment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from tools.terminal import table_of


def inclination_errors_deg(rows: NDArray[np.float64], truth: Mapping[str, Any]) -> NDArray[np.float64]:
    """(n,) angle between estimated and true up for rows (n, 5) of time in ns and quaternion; nan beyond the truth."""
    t, q = truth["t_ns"].astype(np.float64), truth["quaternion"]
    index = np.clip(np.searchsorted(t, rows[:, 0]), 1, len(t) - 1)
    share = ((rows[:, 0] - t[index - 1]) / (t[index] - t[index - 1]))[:, None]
    between = q[index - 1] + share * (
        q[index] * np.sign(np.sum(q[index] * q[index - 1], axis=1))[:, None] - q[index - 1]
    )
    cosine = np.sum(_up(rows[:, 1:]) * _up(between / np.linalg.norm(between, axis=1)[:, None]), axis=1)
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    angle[(rows[:, 0] < t[0]) | (rows[:, 0] > t[-1])] = np.nan
    return angle


def _up(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 3) the world's z in the body frame."""
    w, x, y, z = q.T
    return np.stack([2 * (x * z - w * y), 2 * (w * x + y * z), 1 - 2 * (x * x + y * y)], axis=1)


def complete_run(outcome: dict[str, Any], truth: Mapping[str, Any] | None) -> dict[str, Any]:
    """The firmware's outcome with attitude errors instead of attitudes. Without an emulated body there are none."""
    attitudes = outcome.pop("attitudes")
    errors: dict[str, Any] = {}
    for name, rows in attitudes.items():
        errors[name] = {"inclination_rms_deg": None, "inclination_max_deg": None}
        if truth is not None and "quaternion" in truth and len(rows) > 1:
            angle = inclination_errors_deg(np.array(rows, dtype=np.float64), truth)
            angle = angle[np.isfinite(angle)]
            if len(angle):
                errors[name] = {
                    "inclination_rms_deg": float(np.sqrt(np.mean(angle**2))),
                    "inclination_max_deg": float(np.max(angle)),
                }
    return {**outcome, "attitude": errors}


def print_run(result: dict[str, Any], console: Console) -> None:
    """Print the report for people."""
    table = table_of(
        f"{result['bench']}: {result['ran_s']:.1f} s, {result['clock']} time, steered by {result['steered_by']}",
        "sensor", "received", "lost", "masked", "bad frames", "up rms (deg)", "up max (deg)",
    )  # fmt: skip
    for name, s in result["sensors"].items():
        error = result["attitude"][name]
        figures = (error["inclination_rms_deg"], error["inclination_max_deg"])
        lines = ["-" if v is None else f"{v:.2f}" for v in figures]
        received = f"{s['received']} of {s['expected']}"
        table.add_row(name, received, str(s["lost"]), str(s["masked"]), str(s["bad_frames"]), *lines)
    console.print(table)
    view, game = result["view"], result["experiment"]
    console.print(f"view {view['x']:.0f}, {view['y']:.0f} px, side {view['size']:.0f} px, status {view['status']}")
    if game["reached"]:
        console.print(
            f"targets {game['reached']} of {game['targets']} in {game['elapsed_s']:.1f} s, {game['clicks']} clicks"
        )
    console.print(f"ended: {result['safe_state']['reason']}")


def status_table(status: dict[str, Any], seconds: float) -> Table:
    """A few numbers while it runs."""
    title = f"micron run  {status['t_s']:.1f} of {seconds:g} s  [{status['state']}, {status['mode']}]"
    table = table_of(title, "", "", "", "", left=0)
    table.add_row("roll, pitch, yaw (deg)", *(f"{v:.1f}" for v in status["angles_deg"]))
    table.add_row("view x, y, side (px)", *(f"{v:.0f}" for v in status["view"]))
    table.add_row("targets, lost, ticks skipped", str(status["reached"]), str(status["lost"]), str(status["skipped"]))
    return table
