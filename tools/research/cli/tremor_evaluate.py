"""``micron tremor evaluate``: estimators on recorded hands, beside the limit."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from firmware_py.tremor.config import METHODS, Method, all_methods
from tools.cli.common import JsonOption, clear_errors, console, data_console, print_note, print_whole
from tools.cli.run import estimator_name
from tools.errors import InputError
from tools.output import check_writable, write_json
from tools.research.tremor.baselines import BASELINES
from tools.terminal import spinner


def evaluate(
    recordings: Annotated[
        list[str],
        typer.Argument(
            metavar="RECORDING...",
            help="Data set folder, .npz, .csv, recording folder, run (.mcap), or hand:SEED; PATH#NAME#start:stop.",
        ),
    ],
    method: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Name of an estimator; repeat for more. Default: all.", show_default=False),
    ] = None,
    horizons_ms: Annotated[
        str, typer.Option(metavar="MS,...", help="Prediction horizons, in ms, with commas.")
    ] = "0,2,8,20",
    as_recorded: Annotated[
        bool,
        typer.Option(
            "--as-recorded", help="Keep the size as recorded and add no sensor noise (default: the instrument's)."
        ),
    ] = False,
    with_manners: Annotated[
        bool, typer.Option("--manners", help="Also score onset, frequency jump and growing bias.")
    ] = False,
    png: Annotated[Path | None, typer.Option(metavar="FILE", help="Error against horizon as a picture.")] = None,
    series: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Picture of the first recording: motion and residual of each method over time."
        ),
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Score each method at each horizon: residual, band, delay, frequency error and time per sample, beside the limit.

    Example: micron tremor evaluate ../shared/data/tremor_mouse_lsm9ds1#23/gyro hand:1 hand:2 --method adaptive

    Example: micron tremor evaluate hand:3 --method adaptive --method wflc_flc --manners --series out/left.png
    """
    from tools.research.tremor.cases import cases_from
    from tools.research.tremor.evaluate import Summary, summarise
    from tools.research.tremor.evaluate import evaluate as evaluate_cases
    from tools.research.tremor.evaluate_picture import LOOP_MS, save_horizon_picture, save_series_picture
    from tools.research.tremor.manners import manners

    def table(group: str, lines: list[Summary]) -> Table:
        title = f"{group} ({lines[0].cases}): left of the involuntary motion, % rms"
        table = Table(title=title, title_justify="left", box=None, padding=(0, 1))
        table.add_column("method", no_wrap=True)
        for name in ("ms", "all", "8-12", "lifted", "/others", "/oracle", "/unseen", "late ms", "Hz off", "us"):
            table.add_column(name, justify="right", no_wrap=True)
        for s in lines:
            table.add_row(
                s.method,
                str(s.horizon_ms),
                *(f"{v:.1f}" for v in (s.all_percent, s.band_percent, s.lifted_percent)),
                *(f"{v:.2f}" for v in (s.to_others, s.to_oracle, s.to_unseen, s.delay_ms, s.frequency_error_hz)),
                f"{s.us_per_sample:.1f}",
            )
        return table

    with clear_errors():
        check_writable(json_file, png, series)
        methods = _methods(method)
        horizons = _horizons(horizons_ms)
        cases = [c for source in recordings for c in cases_from(source, not as_recorded, not as_recorded)]
        for note in dict.fromkeys(f"{c.name}: {note}" for c in cases for note in c.notes):
            print_note(note)
        with spinner(console()) as show:
            results = evaluate_cases(cases, methods, horizons, progress=show)
            behaviour = manners(methods) if with_manners else []
        lines = summarise(results)
        if png is not None:
            save_horizon_picture(lines, png)
        if series is not None:
            save_series_picture(cases[0], methods, min(horizons, key=lambda h: abs(h - LOOP_MS)), series)
        if json_file != "-":
            for group in dict.fromkeys(line.group for line in lines):
                print_whole(table(group, [line for line in lines if line.group == group]))
            if behaviour:
                tones = Table(title="a tone of 25 um, sensor noise on", title_justify="left")
                for name in ("method", "onset s", "9 -> 11 Hz s", "bias +5 mg/s: left, ratio", "Hz off"):
                    tones.add_column(name)
                for b in behaviour:
                    figures = (b.onset_s, b.jump_s, b.drift_share, b.drift_frequency_error_hz)
                    tones.add_row(b.method, *(f"{v:.2f}" for v in figures))
                data_console().print(tones)
        write_json(
            {
                "format": 1,
                "rows": [r.as_dict() for r in results],
                "summary": [vars(s) for s in lines],
                "manners": [b.as_dict() for b in behaviour],
            },
            json_file,
        )


def _methods(names: list[str] | None) -> list[Method]:
    wanted = [estimator_name(name) for name in names or (*METHODS, *BASELINES)]
    return [m for m in all_methods() if m in wanted]


def _horizons(text: str) -> list[int]:
    try:
        values = [int(v) for v in text.split(",")]
    except ValueError:
        raise InputError(f"--horizons-ms {text}: whole milliseconds with commas between, for example 0,2,8") from None
    if any(not 0 <= v <= 50 for v in values):
        raise InputError(f"--horizons-ms {text}: from 0 to 50 ms")
    return values
