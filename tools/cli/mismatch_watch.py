"""Implements ``micron mismatch watch``: it finds when and where a recording departs from its twin."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tools.cli.common import JsonOption, clear_errors, data_console
from tools.cli.trust import OutsideOption, TrustOption, decide_on
from tools.errors import InputError
from tools.output import check_writable, write_json

LEAST_PER_HOUR, MOST_PER_HOUR = 1e-6, 60.0

FalseAlarmsOption = Annotated[
    float,
    typer.Option("--false-alarms-per-hour", metavar="R", help="False alarms per hour, of all channels together."),
]


def check_rate(false_alarms_per_hour: float) -> None:
    """Refuse a rate of false alarms that no test can have."""
    if not LEAST_PER_HOUR <= false_alarms_per_hour <= MOST_PER_HOUR:
        raise InputError(
            f"--false-alarms-per-hour {false_alarms_per_hour:g}: must be {LEAST_PER_HOUR:g} to {MOST_PER_HOUR:g}"
        )


def watch(
    *,
    twin: Annotated[
        Path, typer.Argument(metavar="TWIN", help="Corrected twin that 'apply' wrote: .toml, .py or .fmu.")
    ],
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="A recording (folder or .toml).")],
    reference: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", help="First part, in which the twin is good; default: a third, at most 300."),
    ] = None,
    false_alarms_per_hour: FalseAlarmsOption = 0.01,
    json_file: JsonOption = None,
    trust: TrustOption = False,
    allow_outside: OutsideOption = False,
) -> None:
    """Say when and in which channel a recording leaves its twin, or that it does not.

    A sequential test with a stated rate of false alarms looks at the residual, from its first part on.

    Example: micron mismatch watch twin.toml rec --reference 60
    """
    with clear_errors():
        check_writable(json_file, reads=[twin, recording])
        check_rate(false_alarms_per_hour)
        decide_on([twin, recording], trust, allow_outside)
        from tools.mismatch.watch.offline import lines, watch_recording

        watched = watch_recording(twin, recording, reference, false_alarms_per_hour)
        say = data_console(json_file)
        for line in lines(watched):
            say.print(line, highlight=False, markup=False, soft_wrap=True)
        write_json(watched.to_json(), json_file)
