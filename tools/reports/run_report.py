"""The report of a run: JSON of the contract, tables for the terminal, a picture, a self-contained page."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from hal.arrays import Array
from tools.output import Outputs, make_folder_of, write_bytes_atomic, write_json, write_text_atomic
from tools.reports.figures import AXES, FOUR_BANDS_HZ, SHOWN_HZ, TREMOR_BAND_HZ, band_name, band_pass, density_text
from tools.terminal import table_of

NOTHING_UM = 0.2
"""Below this a percentage says nothing: the change is given in um."""


def headline(result: Mapping[str, Any]) -> str:
    """Return the main result in one sentence."""
    tremor = result["tremor"]
    if result["armed_ns"] is None:
        return "Nothing was armed, so there is nothing to compare."
    if tremor["reduction_percent"] is None:
        return "No tremor figure: it needs an emulated bench, which knows the truth, and a run of more than 3 s."
    low_hz, high_hz = tremor["band_hz"]
    return (
        f"Tip tremor {low_hz:g}-{high_hz:g} Hz: {tremor['uncompensated_rms_um']:.1f} um rms without, "
        f"{tremor['compensated_rms_um']:.1f} with compensation: {tremor['reduction_percent']:.0f} % less."
    )


def _number(value: float | None, pattern: str = "{:.1f}") -> str:
    return "-" if value is None or not np.isfinite(value) else pattern.format(value)


def _compared(without_um: float | None, with_um: float | None) -> str:
    """The change in per cent, or in um where there was next to nothing to begin with."""
    if without_um is None or with_um is None:
        return "-"
    if without_um < NOTHING_UM or with_um > 2.0 * without_um:
        return f"adds {with_um - without_um:.2f} um"
    change = 100.0 * (1.0 - with_um / without_um)
    return f"{change:.0f} % less" if change >= 0.0 else f"{-change:.0f} % more"


_CLOSE: dict[str, Any] = {"box": None, "padding": (0, 1, 0, 0), "pad_edge": False}
"""How a table with many columns is set."""


def tremor_table(result: Mapping[str, Any]) -> Table:
    """Return a table of the tremor without and with compensation, per axis and as a vector, and of the tip's error in
    each band."""
    title = "Motion of the tip, um rms (physical truth)"
    table = table_of(title, "", "without", "with", "compensation", box=box.SIMPLE_HEAD)

    def add(name: str, without_um: float | None, with_um: float | None) -> None:
        figures = (_number(v, "{:.2f}") for v in (without_um, with_um))
        table.add_row(name, *figures, _compared(without_um, with_um))

    tremor = result["tremor"]
    for name, figures in [*((f"tremor 8-12 Hz, {axis}", tremor["per_axis"][axis]) for axis in AXES)]:
        add(name, figures["uncompensated_rms_um"], figures["compensated_rms_um"])
    add("tremor 8-12 Hz, all axes", tremor["uncompensated_rms_um"], tremor["compensated_rms_um"])
    for band in tremor.get("bands", ()):
        name = band_name((band["low_Hz"], band["high_Hz"]))
        add(f"error of path, {name}", band["without_um"], band["with_um"])
    return table


def spectrum_table(result: Mapping[str, Any]) -> Table:
    """Return a table of the spectrum of the tip's error, without and with compensation, at ``SHOWN_HZ``."""
    spectrum = result["tremor"]["spectrum"]
    at = [n for n, hz in enumerate(spectrum["hz"]) if hz in SHOWN_HZ]
    headings = ("Hz", *(f"{spectrum['hz'][n]:g}" for n in at))
    table = table_of("Spectrum of the tip's error of path, um/sqrt(Hz)", *headings, no_wrap=True, **_CLOSE)
    for name in ("without", "with"):
        table.add_row(name, *(density_text(spectrum[f"{name}_um_rtHz"][n]) for n in at))
    return table


def task_table(result: Mapping[str, Any]) -> Table:
    """Every task's time and CPU time against its budget, in us; fits eighty columns."""
    time = "wall" if result.get("clock") == "real" else "emulated"
    short = time[:4]
    figures = (f"{short}\np50", f"{short}\np99", f"{short}\nmax", "CPU\np50", "CPU\np99", "bud-\nget")
    headings = ("\ntask", "\nHz", "\nruns", *figures, "runs\nover", "put\noff")
    table = table_of(f"Tasks: {time} time and host CPU time of a run, us", *headings, no_wrap=True, **_CLOSE)
    for name, task in result["tasks"].items():
        duration, cpu = task["duration_us"], task["cpu_us"]
        table.add_row(
            name,
            _number(task["rate_hz"], "{:g}"),
            str(task["runs"]),
            *(_number(duration[key], "{:.0f}") for key in ("p50", "p99", "max")),
            *(_number(cpu[key], "{:.0f}") for key in ("p50", "p99")),
            _number(task["budget_us"], "{:g}"),
            str(task["overruns"]),
            str(task["put_off"]),
        )
    return table


def task_legend(result: Mapping[str, Any]) -> str:
    """Explain the two times of the task table."""
    if result.get("clock") == "real":
        return "wall: from the start of a run to its end on this machine; CPU: without the waiting for buses."
    return (
        "emul: bus and device time, exact, the same on every machine; CPU: what this\n"
        "machine spent, its emulated devices included. Budgets are for the first."
    )


def host_line(result: Mapping[str, Any]) -> str:
    """Return how the host kept up. A pause of the host is no fault in emulated time."""
    host = result.get("host", {})
    if host.get("pace") != "paced":
        line = f"scheduling: {result['realtime']}" + machine_lines(result)
        if host.get("stalls"):
            line += (
                f"\nthis host stood still {host['stalls']} times, longest {host['longest_stall_ms']:.1f} ms: not fit "
                "for a 1 kHz loop;\nsee docs/lab-machine.md, or run without --realtime"
            )
        return line
    emulated_s, wall_s = host["emulated_s"], host["wall_s"]
    line = f"pace: {emulated_s:.1f} s of emulated time took {wall_s:.1f} s"
    if wall_s > 1.05 * emulated_s:
        line += "; the result does not change"
    if host["stalls"]:
        line += f"\n{host['stalls']} pauses of the host, longest {host['longest_stall_ms']:.0f} ms, were waited out"
    return line


def machine_lines(result: Mapping[str, Any]) -> str:
    """Return lines on what the loop used of its processor, and on settings of the machine that are not as wanted."""
    lines: list[str] = []
    if (cpu := result["host"].get("cpu_share")) is not None:
        lines.append(f"processor: the firmware used {100 * cpu:.0f} % of one")
        if "spin_share" in (loop := result.get("loop", {})):
            lines[-1] += f"; {100 * loop['spin_share']:.0f} % was spinning for scans"
    if slow := [setting["name"] for setting in result.get("machine", ()) if not setting["good"]]:
        lines.append(f"machine: not as wanted: {', '.join(slow)}; see micron doctor")
    return "".join(f"\n{line}" for line in lines)


def summary_lines(result: Mapping[str, Any]) -> list[str]:
    """Return the lines that are no table: latency, scans, holds, voluntary motion, safe state, recording."""
    latency = result["latency"]["sample_to_command_us"]
    samples, safe, voluntary = result["samples"], result["safe_state"], result["voluntary"]
    lines = [
        "sample to command: "
        + ", ".join(
            f"{name} {_number(latency[key], '{:.0f}')} us"
            for name, key in (("p50", "p50"), ("p99", "p99"), ("p99.9", "p99_9"), ("max", "max"))
        ),
        f"scans: {samples['received']} of {samples['expected']} received, {samples['lost']} lost; "
        f"commands: {result['commands']['sent']} sent, {result['commands']['clipped']} clipped",
        f"ticks: {result['ticks']['run']} run, {result['ticks']['skipped']} skipped, {result['ticks']['caught_up']} "
        "caught up without a command",
    ]
    if passed_over := result["commands"].get("superseded"):
        sent = result["commands"]["sent"]
        lines.append(
            f"the amplifier is slower than the ticks: {sent} commands sent, {passed_over} passed over for newer"
        )
    kinematics = result.get("kinematics", {})
    if kinematics and (kinematics["method"] == "numeric" or kinematics["fallbacks"]):
        other = {"numeric": "analytic", "analytic": "numeric"}[kinematics["method"]]
        lines.append(
            f"{kinematics['method']} kinematics: {kinematics['fallbacks']} ticks fell back to the {other} solution"
        )
    for hold in result.get("holds", ()):
        lines.append(f"hold at {hold['t_s']:.1f} s for {hold['length_s']:.2f} s ({hold['class']}): {hold['cause']}")
    if result["noticed"]:
        lines.append("noticed: " + ", ".join(result["noticed"]))
    if voluntary["gain"] is not None:
        lines.append(f"voluntary motion below 1 Hz: gain {voluntary['gain']:.4f}, delay {voluntary['delay_ms']:.2f} ms")
    if any(result.get("warnings", {}).values()):
        lines.append(
            "hand, noted without consequence: "
            + ", ".join(f"{what} {'once' if n == 1 else f'{n} times'}" for what, n in result["warnings"].items() if n)
        )
    reached = "reached" if safe["reached"] else "NOT CONFIRMED"
    lines.append(f"safe state {reached}: {safe['reason']}")
    lines.append(host_line(result))
    if result["recording"]:
        lines.append(f"recording: {result['recording']}")
        if problem := result["recorder"].get("problem"):
            lines.append(f"NOT RECORDED AS ASKED: {problem}")
    return lines


def next_steps(result: Mapping[str, Any]) -> list[str]:
    """Commands that make sense after this run."""
    replay = result["recording"] or "first.mcap"
    steps = ["micron bench                           the live page of the instrument"]
    if not result["recording"]:
        steps.append("micron run --record first.mcap         record a run")
    steps.append(f"micron replay {replay:<24} run it again, bit for bit")
    steps.append("micron mismatch --help                 what a simulation lacks")
    return ["next:", *(f"  {step}" for step in steps)]


def print_report(result: Mapping[str, Any], console: Console) -> None:
    """The whole report for a terminal: the result in one sentence, the tables, what to do next."""
    parts: list[Any] = ["", Text(headline(result), "bold"), ""]
    if result["tremor"]["reduction_percent"] is not None:
        parts.append(tremor_table(result))
        if result["tremor"]["spectrum"]["hz"]:
            parts += [spectrum_table(result), ""]
    parts += [task_table(result), Text(task_legend(result), "dim"), "", *summary_lines(result), ""]
    console.print(Group(*parts))


def picture(truth: Mapping[str, Array], result: Mapping[str, Any]) -> bytes:
    """Return a PNG (bytes): three axes before and after in the tremor band, the last 3 s that were scored, the spectra,
    and the error in four bands."""
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
            right.loglog(frequency[1:], np.sqrt(power[1:]), color=colour, lw=1.2)
        right.set_xlim(frequency[1], 0.5 * rate_hz)
        right.set_ylim(1e-3, None)
        right.set_ylabel("um/sqrt(Hz)")
        right.axvspan(*TREMOR_BAND_HZ, color="C1", alpha=0.12, lw=0)
        right.grid(alpha=0.3)
    panels[0, 0].legend(loc="upper right", ncols=2, fontsize=9)
    panels[2, 0].set_xlabel("time since scoring began (s)")
    panels[2, 1].set_xlabel("frequency (Hz)")
    bands = {(b["low_Hz"], b["high_Hz"]): (b["without_um"], b["with_um"]) for b in result["tremor"]["bands"]}
    rows = [(band_name(band), *bands[band]) for band in FOUR_BANDS_HZ if band in bands]
    errors = "; ".join(f"{name} {before:.2f} to {after:.2f}" for name, before, after in rows)
    figure.suptitle(f"{headline(result)}\nError of path, um rms: {errors}", fontsize=12)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    plt.close(figure)
    return buffer.getvalue()


def html_page(result: Mapping[str, Any], image: bytes | None) -> str:
    """Return one self-contained page."""
    from jinja2 import Environment

    page = Path(__file__).with_name("run_page.html.j2").read_text(encoding="utf-8")
    template = Environment(autoescape=True).from_string(page)
    encoded = base64.b64encode(image).decode() if image else ""
    return template.render(result=result, headline=headline(result), lines=summary_lines(result), image=encoded)


def save_picture(image: bytes, path: Path) -> None:
    """Write the PNG, making its folder."""
    make_folder_of(path)
    write_bytes_atomic(path, image)


def write_report(
    result: Mapping[str, Any],
    truth: Mapping[str, Array] | None,
    console: Console,
    *,
    json_file: str | None,
    html: Path | None,
    image: Path | None,
    more: Sequence[str] = (),
) -> None:
    """Write table, JSON, picture and page of a run, none of which depends on another one, then the lines ``more``.

    Raises ``OutputError`` at the end, with everything that could not be written.
    """
    outputs = Outputs()
    with outputs.part("table"):
        print_report(result, console)
    with outputs.part("JSON"):
        write_json(result, json_file)
    png: bytes | None = None
    if truth is not None and result["tremor"]["reduction_percent"] is not None:
        with outputs.part("picture"):
            png = picture(truth, result)
            if image is not None:
                save_picture(png, image)
                console.print(f"picture: {image}")
    if html is not None:
        with outputs.part("page"):
            write_text_atomic(html, html_page(result, png))
    with outputs.part("what to do next"):
        for line in more:
            console.print(line, soft_wrap=True)
    outputs.finish()
