"""Implements ``micron mismatch plan``: it proposes what to record next."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Annotated, Any

import typer

from tools.cli.bench_option import BenchOption, bench_path
from tools.cli.common import JsonOption, clear_errors, console, data_console
from tools.cli.trust import OutsideOption, TrustOption, decide_on
from tools.errors import InputError
from tools.output import check_folder, check_writable, write_json
from tools.terminal import progress_bar, task_name


def read_report(path: Path) -> dict[str, Any]:
    """Return the JSON that ``diagnose --json`` wrote. Raises InputError for anything else."""
    try:
        body = json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give what diagnose --json wrote") from error
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"{path}: not JSON ({error}); give what diagnose --json wrote") from error
    if not isinstance(body, dict):
        raise InputError(f"{path}: not a mismatch report; give what diagnose --json wrote")
    return body


def plan(
    *,
    twin: Annotated[
        Path, typer.Argument(metavar="TWIN", help="A recording, a recording.toml without data, or a twin file.")
    ],
    report: Annotated[
        Path | None, typer.Option(metavar="REPORT.json", help="Its diagnosis: plan the input that splits a group.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="With --report: input.csv, input.npz, plan.png, program.toml.")
    ] = None,
    amplitude: Annotated[float | None, typer.Option(help="Largest distance from the centre, channel's unit.")] = None,
    centre: Annotated[float | None, typer.Option(help="Centre of the input, channel's unit.")] = None,
    rms: Annotated[float | None, typer.Option(help="Largest rms about the centre, channel's unit.")] = None,
    rate: Annotated[float | None, typer.Option(help="Fastest change, channel's unit per second.")] = None,
    band: Annotated[str | None, typer.Option(metavar="LOW:HIGH", help="Frequencies, Hz.")] = None,
    duration: Annotated[float | None, typer.Option(metavar="S", help="Length of the recording.")] = None,
    inputs: Annotated[
        list[str] | None, typer.Option("--input", metavar="SIGNAL", help="Plan this input alone; may be repeated.")
    ] = None,
    size: Annotated[float, typer.Option(min=0.01, help="Effects of this many noise rms are compared.")] = 3.0,
    noise: Annotated[float | None, typer.Option(metavar="RMS", help="Noise of outputs that declare none.")] = None,
    bench: BenchOption = None,
    stack: Annotated[
        list[int] | None, typer.Option(min=1, max=3, help="With --bench: move this stack; one for each planned input.")
    ] = None,
    evaluations: Annotated[int, typer.Option(min=24, help="Inputs that the search tries.")] = 80,
    seed: Annotated[int, typer.Option(min=0, help="Same seed: same plan.")] = 0,
    json_file: JsonOption = None,
    trust: TrustOption = False,
    allow_outside: OutsideOption = False,
) -> None:
    """Say which effects a recording could tell apart, or plan the one that splits what a diagnosis could not.

    Without --report: the smallest effect of each kind that the channels would show, and what would split the rest.
    With it: the input within your limits on which the equivalent models differ most (docs/mismatch.md).

    Example: micron mismatch plan recordings/stack
    """
    with clear_errors():
        check_writable(json_file, reads=[twin, report])
        check_folder(out)
        for name, value in (("--out", out), ("--stack", stack or None)):
            if value is not None and report is None:
                raise InputError(f"{name} belongs to --report: without one nothing is planned")
        if stack and bench is None:
            raise InputError("--stack belongs to --bench: it says which stack of the bench the program moves")
        if noise is not None and not 0.0 < noise < 1e9:
            raise InputError(f"--noise {noise:g}: must be a positive number")
        decide_on([twin], trust, allow_outside)
        from hal.bench import load_bench
        from tools.mismatch.plan import plan as planning
        from tools.mismatch.plan.limits import Wish, bench_limits, parse_band
        from tools.mismatch.plan.write import FILES

        check_folder(out, files=FILES, reads=[twin, report])

        limits = None if bench is None else bench_limits(load_bench(bench_path(bench)))
        wish = Wish(amplitude, centre, rate, parse_band(band), duration, rms)
        asked = planning.Asked(
            wish, tuple(inputs or ()), noise, None, size, evaluations, seed, limits, tuple(stack or ())
        )
        say = data_console(json_file)
        if report is None:
            from tools.mismatch.plan.show import print_prospect

            found = planning.prospect(twin, asked)
            print_prospect(found, say)
            write_json(found.to_json(), json_file)
            return
        _plan_for(twin, read_report(report), asked, out=out, json_file=json_file)


def _plan_for(twin: Path, report: dict[str, Any], asked: Any, *, out: Path | None, json_file: str | None) -> None:
    from rich.progress import BarColumn, TextColumn

    from tools.mismatch.plan import plan as planning
    from tools.mismatch.plan.show import print_plan
    from tools.mismatch.plan.write import PICTURE, PROGRAM, draw_plan, write_plan

    columns = (task_name(), BarColumn(), TextColumn("{task.completed}/{task.total}"))
    with progress_bar(console(), *columns) as bars:
        bar = bars.add_task("inputs", total=asked.evaluations)
        designed = planning.plan_for(
            twin, report, asked, lambda what, done, total: bars.update(bar, completed=done, total=total)
        )
    print_plan(designed, data_console(json_file))
    if out is not None:
        files = write_plan(designed.plan, designed.where, out, designed.stacks)
        draw_plan(designed.plan, designed.where, designed.rivals, dict(designed.sigma), out / PICTURE)
        console().print(f"written: {', '.join(str(f) for f in (*files, out / PICTURE))}", soft_wrap=True)
        if designed.stacks:
            console().print(f"next: micron run --virtual --manual {shlex.quote(str(out / PROGRAM))}", soft_wrap=True)
    write_json(designed.to_json(), json_file)
