"""Implements ``micron recover`` and ``micron export``: torn recordings made whole, and other formats."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Annotated

import typer

from firmware_py.recording.cut import cut
from firmware_py.recording.reader import Recording
from firmware_py.recording.recover import recover as recover_recording
from tools.cli.common import Exit, JsonOption, check_recording_name, clear_errors, console
from tools.errors import InputError
from tools.formats.export import FORMATS, ExportReport
from tools.formats.export import export as export_recording
from tools.output import check_writable, write_json

Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace the output file if it is there.")]


def recover(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A recording that a killed run left behind.")],
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Default: NAME.recovered.mcap beside it.")] = None,
    overwrite: Overwrite = False,
    json_file: JsonOption = None,
) -> None:
    """Make a finished recording of what is sound in FILE and say exactly what is missing (exit 3 if anything is).

    Example: micron recover out/run.mcap
    """
    with clear_errors():
        check_writable(json_file, out, reads=[file], overwrite=overwrite)
        check_recording_name(out)
        report = recover_recording(file, out or file.with_suffix(".recovered.mcap"), overwrite=overwrite)
        for line in report.lines():
            console().print(line, soft_wrap=True)
        write_json({"format": 1, **report.as_dict()}, json_file)
        if report.exit_code:
            raise typer.Exit(report.exit_code)


def export(
    *,
    file: Annotated[Path, typer.Argument(metavar="RUN", help="A recording (.mcap).")],
    to: Annotated[
        Path | None,
        typer.Argument(metavar="OUT", help=f"name.{', .'.join(FORMATS)} for viewers, or a folder."),
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="PATH", help="Output file, as the argument OUT.")] = None,
    raw: Annotated[bool, typer.Option("--raw", help="With .mcap: write a recording that can be replayed.")] = False,
    from_s: Annotated[
        float | None,
        typer.Option("--from", metavar="S", help="Start of the span, in s. Default: the start of the recording."),
    ] = None,
    to_s: Annotated[float | None, typer.Option("--to", metavar="S", help="End of the span, in s.")] = None,
    overwrite: Overwrite = False,
    json_file: JsonOption = None,
) -> None:
    """Write a recording, or a span of it, as csv, npz, parquet, nc, mf4, mcap, or a folder for the mismatch engine.

    An .mcap is for viewers: Foxglove, PlotJuggler and rerun plot it. With --raw it is a recording for 'micron replay'.

    Example: micron export out/run.mcap out/view.mcap
    """
    with clear_errors():
        check_writable(json_file)
        out = _target(to, out, raw)
        check_writable(json_file, out, folders=True, reads=[file], overwrite=overwrite)
        recording = Recording(file)
        with tempfile.TemporaryDirectory(prefix="micron-") as scratch:
            if from_s is not None or to_s is not None or raw:
                span = (-math.inf if from_s is None else from_s, math.inf if to_s is None else to_s)
                part = out if raw else Path(scratch) / file.name
                cut(recording, part, *span, overwrite=overwrite)
                recording = Recording(part)
            if raw:
                report = ExportReport(out, "mcap", recording.n_rows, len(recording.columns))
            else:
                report = export_recording(recording, out, overwrite=overwrite)
        for note in report.notes:
            console().print(note, soft_wrap=True)
        console().print(f"{report.path}: {report.rows} ticks, {report.columns} columns", soft_wrap=True)
        write_json(
            {
                "format": 1,
                "path": str(report.path),
                "kind": report.format,
                "rows": report.rows,
                "columns": report.columns,
                "health": recording.health.as_dict(),
            },
            json_file,
        )
        if recording.health.lost:
            for line in recording.health.lines():
                console().print(line, soft_wrap=True)
            raise typer.Exit(Exit.DATA_LOST)


def _target(to: Path | None, out: Path | None, raw: bool) -> Path:
    """Return where an export goes. Raises ``InputError`` for no place, two places, or ``--raw`` to another format."""
    if (to is None) == (out is None):
        raise InputError("name one file or folder to write, as in: micron export RUN OUT")
    target = to or out
    assert target is not None
    if raw and target.suffix != ".mcap":
        raise InputError(f"{target}: --raw writes a recording; name a file that ends in .mcap")
    return target
