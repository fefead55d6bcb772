"""The report of a run: JSON of the contract, tables for the terminal, a picture, a self-contained page."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console, Group
from rich.table import Table

from tools.reports.tremor_figures import AXES, TREMOR_BAND_HZ, band_pass

Array = NDArray[np.float64]


def headline(result: Mapping[str, Any]) -> str:
    """The main job in one sentence."""
    tremor = result["tremor"]
    if result["armed_ns"] is None:
        return "Nothing was armed, so there is nothing to compare."
    if tremor["reduction_percent"] is None:
        return "No tremor figure: it needs an emulated bench (the truth is its) and a run of more than a few seconds."
    return (
        f"Tip tremor {tremor['uncompensated_rms_um']:.1f} um rms without, "
        f"{tremor['compensated_rms_um']:.1f} um rms with compensation: "
        f"{tremor['reduction_percent']:.0f} % less in {tremor['band_hz'][0]:g}-{tremor['band_hz'][1]:g} Hz."
    )


def _number(value: float | None, pattern: str = "{:.1f}") -> str:
    return "-" if value is None or not np.isfinite(value) else pattern.format(value)


def tremor_table(result: Mapping[str, Any]) -> Table:
    """Tremor without and with compensation, per axis and as a vector."""
    table = Table(title="Tip tremor and tip error (truth)", title_justify="left")
    for column in ("", "without (um rms)", "with (um rms)", "less (%)"):
        table.add_column(column, justify="left" if not column else "right")
    tremor = result["tremor"]
    rows = [(f"{axis}, tremor band", tremor["per_axis"][axis]) for axis in AXES]
    rows += [
        ("vector, tremor band", tremor),
        ("vector, all bands, against intended path", tremor["whole_band_error"]),
    ]
    for name, figures in rows:
        table.add_row(
            name,
            _number(figures["uncompensated_rms_um"], "{:.2f}"),
            _number(figures["compensated_rms_um"], "{:.2f}"),
            _number(figures["reduction_percent"]),
        )
    return table


def task_table(result: Mapping[str, Any]) -> Table:
    """Every task against its budget, times in us; whole on eighty columns."""
    title = "Tasks: us of budget and runs; CPU of a run; runs over budget, releases skipped, times put off"
    table = Table(title=title, title_justify="left", box=None, padding=(0, 1, 0, 0), pad_edge=False)
    figures = ("budget", "p50", "p99", "p99.9", "max", "cpu", "over", "skip", "off")
    for column in ("task", "Hz", "runs", *figures):
        table.add_column(column, justify="left" if column == "task" else "right", no_wrap=True)
    for name, task in result["tasks"].items():
        duration, cpu = task["duration_us"], task["cpu_us"]
        table.add_row(
            name,
            _number(task["rate_hz"], "{:g}"),
            str(task["runs"]),
            _number(task["budget_us"], "{:g}"),
            *(_number(duration[key], "{:.0f}") for key in ("p50", "p99", "p99_9", "max")),
            _number(cpu["p50"], "{:.0f}"),
            str(task["overruns"]),
            str(task["skipped"]),
            str(task["put_off"]),
        )
    return table


def summary_lines(result: Mapping[str, Any]) -> list[str]:
    """What is not a table: latency, scans, voluntary motion, safe state, recording."""
    latency = result["latency"]["sample_to_command_us"]
    samples, safe, voluntary = result["samples"], result["safe_state"], result["voluntary"]
    lines = [
        "sample to command: "
        + ", ".join(
            f"{name} {_number(latency[key], '{:.0f}')} us"
            for name, key in (("p50", "p50"), ("p99", "p99"), ("p99.9", "p99_9"), ("max", "max"))
        ),
        f"scans: {samples['received']} of {samples['expected']} received, {samples['lost']} lost; "
        f"{result['ticks']['skipped']} ticks skipped, {result['ticks']['caught_up']} caught up without a command of "
        f"their own, {result['commands']['clipped']} commands clipped",
    ]
    if passed_over := result["commands"].get("superseded"):
        sent = result["commands"]["sent"]
        lines.append(
            f"the amplifier is slower than the ticks: {sent} commands sent, {passed_over} passed over for newer"
        )
    kinematics = result.get("kinematics", {})
    if kinematics.get("method") == "numeric":
        lines.append(f"numeric kinematics: {kinematics['fallbacks']} ticks fell back to the analytic solution")
    if result["noticed"]:
        lines.append("noticed: " + ", ".join(result["noticed"]))
    if voluntary["gain"] is not None:
        lines.append(f"voluntary motion below 1 Hz: gain {voluntary['gain']:.4f}, delay {voluntary['delay_ms']:.2f} ms")
    if any(result.get("warnings", {}).values()):
        lines.append("hand: " + ", ".join(f"{n} {what}(s)" for what, n in result["warnings"].items() if n))
    reached = "reached" if safe["reached"] else "NOT CONFIRMED"
    lines.append(f"safe state {reached}: {safe['reason']}")
    lines.append(f"scheduling: {result['realtime']}")
    if result["recording"]:
        lines.append(f"recording: {result['recording']}")
    return lines


def print_report(result: Mapping[str, Any], console: Console) -> None:
    """The whole report for a terminal."""
    parts: list[Any] = []
    if result["tremor"]["reduction_percent"] is not None:
        parts.append(tremor_table(result))
    parts += [task_table(result), *summary_lines(result), f"[bold]{headline(result)}[/]"]
    console.print(Group(*parts))


def picture(truth: Mapping[str, Array], result: Mapping[str, Any]) -> bytes:
    """PNG: three axes before and after in the tremor band, the last 3 s that were scored, and the spectra."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from scipy.signal import welch

    t_s = (truth["t_ns"] - truth["t_ns"][0]) * 1e-9
    rate_hz = (len(t_s) - 1) / t_s[-1]
    start_s, stop_s = result["tremor"]["evaluated_s"]
    scored = (t_s >= start_s) & (t_s <= stop_s)
    show = scored & (t_s >= stop_s - 3.0)
    before, after = (1e6 * band_pass(np.asarray(truth[k]), rate_hz, TREMOR_BAND_HZ) for k in ("tip_rigid_m", "tip_m"))
    figure, panels = plt.subplots(3, 2, figsize=(12, 7.2), width_ratios=(2.2, 1), layout="constrained")
    for i, axis in enumerate(AXES):
        left, right = panels[i]
        left.plot(t_s[show] - start_s, before[show, i], color="0.65", lw=1.2, label="without compensation")
        left.plot(t_s[show] - start_s, after[show, i], color="C0", lw=1.2, label="with compensation")
        left.set_ylabel(f"{axis}, 8-12 Hz (um)")
        left.grid(alpha=0.3)
        for key, colour in (("tip_rigid_m", "0.65"), ("tip_m", "C0")):
            path = 1e6 * np.asarray(truth[key])[scored, i]
            frequency, power = welch(path, rate_hz, nperseg=min(len(path), 2048), detrend="linear")
            right.semilogy(frequency[1:], np.sqrt(power[1:]), color=colour, lw=1.2)
        right.set_xlim(0, 40)
        right.set_ylim(1e-3, None)
        right.set_ylabel("um/sqrt(Hz)")
        right.axvspan(*TREMOR_BAND_HZ, color="C1", alpha=0.12, lw=0)
        right.grid(alpha=0.3)
    panels[0, 0].legend(loc="upper right", ncols=2, fontsize=9)
    panels[2, 0].set_xlabel("time since scoring began (s)")
    panels[2, 1].set_xlabel("frequency (Hz)")
    figure.suptitle(headline(result), fontsize=12)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    plt.close(figure)
    return buffer.getvalue()


def html_page(result: Mapping[str, Any], image: bytes | None) -> str:
    """One self-contained page."""
    from jinja2 import Environment

    page = Path(__file__).with_name("run_page.html.j2").read_text(encoding="utf-8")
    template = Environment(autoescape=True).from_string(page)
    encoded = base64.b64encode(image).decode() if image else ""
    return template.render(result=result, headline=headline(result), lines=summary_lines(result), image=encoded)


def save_picture(image: bytes, path: Path) -> None:
    """Write the PNG, making its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(image)
