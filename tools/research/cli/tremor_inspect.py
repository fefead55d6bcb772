"""Implements ``micron tremor inspect``: it finds tremor in a recording and measures it."""

from __future__ import annotations

from math import isfinite
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from tools.cli.common import JsonOption, clear_errors, console, print_note, print_whole
from tools.errors import InputError
from tools.output import Outputs, check_writable, write_bytes_atomic, write_json, write_text_atomic


def inspect(
    recording: Annotated[
        str,
        typer.Argument(
            metavar="RECORDING[#NAME][#start:stop]", help="Data set folder, .npz, .csv or recording folder."
        ),
    ],
    low_hz: Annotated[float, typer.Option(min=0.5, help="Lowest frequency searched.")] = 3.5,
    high_hz: Annotated[float, typer.Option(max=30.0, help="Highest frequency searched.")] = 15.0,
    png: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Picture (of one signal: choose with #NAME).")
    ] = None,
    html: Annotated[Path | None, typer.Option(metavar="FILE", help="Page with every signal.")] = None,
    json_file: JsonOption = None,
) -> None:
    """Show spectrum over time, peak frequency with its interval, amplitude, harmonics, tremor or not per window of 4 s.

    Says so when the stated sampling rate is not the real one. Example:
    micron tremor inspect ../shared/data/tremor_mouse_lsm9ds1#23/gyro --png out/23.png
    """
    from tools.research.tremor.inspect import Inspection, Rule, inspect
    from tools.research.tremor.signals import load_signals

    def table(inspections: list[Inspection], whole: bool) -> Table:
        more = ("Hz", "s", "tremor (%)", "peak (Hz)", "95 % (Hz)", "amplitude", "excursion", "2f, 3f (%)")
        less = ("tremor %", "peak, 95 % (Hz)", "excursion")
        rows_table = Table(title=recording, title_justify="left")
        rows_table.add_column("signal", overflow="fold")
        for column in more if whole else less:
            rows_table.add_column(column, justify="right", no_wrap=True)
        for one in inspections:
            s = one.signal
            factor, unit = _readable(one.excursion_unit, one.excursion)
            share, peak, excursion = f"{100 * one.tremor_share:.0f}", f"{one.peak_hz:.2f}", factor * one.excursion
            interval = f"{one.low_hz:.2f}..{one.high_hz:.2f}" if one.steady else "not steady"
            if not whole:
                rows_table.add_row(s.name, share, f"{peak} {interval}", f"{excursion:.3g} {unit}")
                continue
            rows_table.add_row(
                s.name,
                f"{s.rate_hz:.2f}",
                f"{s.seconds:.0f}",
                share,
                peak,
                interval,
                f"{one.amplitude:.3g} {s.unit}",
                f"{excursion:.3g} {unit}",
                ", ".join(f"{100 * h:.0f}" if isfinite(h) else "-" for h in one.harmonics),
            )
        return rows_table

    with clear_errors():
        check_writable(json_file, png, html)
        if not low_hz + 1.0 <= high_hz:
            raise InputError(f"--low-hz {low_hz:g} to --high-hz {high_hz:g}: give a band of 1 Hz or more")
        signals = load_signals(recording)
        if png is not None and len(signals) > 1:
            names = ", ".join(s.name.split("/", 1)[-1] for s in signals[:8])
            raise InputError(
                f"--png shows one signal, {recording} holds {len(signals)}: choose one with #NAME ({names})"
            )
        rule = Rule(band_hz=(low_hz, high_hz))
        result = [inspect(signal, rule) for signal in signals]
        for note in dict.fromkeys(note for s in signals for note in s.notes):
            print_note(note)
        if json_file != "-":
            print_whole(table(result, whole=True), table(result, whole=False))
        outputs = Outputs()
        with outputs.part("JSON"):
            write_json({"format": 1, "source": recording, "signals": [one.as_dict() for one in result]}, json_file)
        if png is not None or html is not None:
            from tools.research.tremor.inspect_picture import inspection_figure, page, png_bytes

            if png is not None:
                with outputs.part("picture"):
                    write_bytes_atomic(png, png_bytes(inspection_figure(result[0])))
                    console().print(f"picture: {png}")
            if html is not None:
                with outputs.part("page"):
                    write_text_atomic(html, page(result))
                    console().print(f"page: {html}")
        outputs.finish()


def _readable(unit: str, size: float) -> tuple[float, str]:
    """Return factor and unit for small excursions of about ``size``."""
    if unit == "m":
        return (1e3, "mm") if size >= 1e-3 else (1e6, "um")
    return (1e3, "mrad") if unit == "rad" else (1.0, unit)
