"""Implements ``micron faults``: it runs the fault campaign on the emulated bench."""

from __future__ import annotations

import os
import shlex
from collections.abc import Sequence
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import BarColumn, TimeElapsedColumn
from rich.table import Table

from firmware_py.compiled.eligible import check_compiled
from firmware_py.recording.revision import git_revision
from hal.bench import load_bench, named_files
from hal.trust import allow_name
from tools.cli.bench_option import BenchOption, bench_path
from tools.cli.common import JsonOption, clear_errors, console, data_console
from tools.errors import InputError
from tools.interrupt import is_stopped
from tools.output import Outputs, check_names, check_writable, write_json
from tools.research.results.artefact import write_result
from tools.research.stamp import revision_and_day
from tools.terminal import progress_bar, task_name

if TYPE_CHECKING:
    from tools.research.faults.fault import Fault


def faults(
    bench: BenchOption = None,
    seeds: Annotated[int, typer.Option(min=1, max=1000, help="Runs per fault, phase and operating point.")] = 1,
    seed: Annotated[int, typer.Option(min=1, max=2**31, help="First seed: hands, noise, instants, pairs.")] = 1,
    pairs: Annotated[
        int, typer.Option(min=0, max=5000, help="Number of pairs of faults that are run in addition.")
    ] = 0,
    only: Annotated[str, typer.Option(metavar="TEXT", help="Only faults whose name contains this.")] = "",
    jobs: Annotated[int, typer.Option(min=1, help="Number of processes.")] = os.cpu_count() or 1,
    beside: Annotated[
        list[str] | None,
        typer.Option(
            metavar="BENCH[#TEXT]",
            help="Run another bench, BENCH#TEXT: only faults whose name contains TEXT. Goes into the same page.",
        ),
    ] = None,
    compiled: Annotated[
        bool, typer.Option("--compiled", help="Run the ticks in the compiled thread, over socket pairs.")
    ] = False,
    keep: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="File of finished runs; a stopped campaign goes on from it.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the result (FILE.json), or its page (FILE.md).")
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Break the emulated instrument in every way of the catalogue, and print what it did.

    Each fault strikes in every phase of a run: self-test, learning, steady, hold and ramp.

    After Ctrl-C what is done is printed and goes into --json, not into --out. Exit status 1 when an output was unsafe,
    a sample uncounted, a message wrong or an answer not as expected.

    Example: micron faults --seeds 5 --pairs 300 --out docs/results/reliability.json
    """
    from tools.research.faults.campaign import run_campaign, totals
    from tools.research.faults.drift_bound import drift_bounds
    from tools.research.faults.page import Beside, markdown
    from tools.research.faults.phases import PHASES
    from tools.research.faults.points import POINTS

    with clear_errors():
        check_names(keep)
        check_writable(json_file, out)
        path = bench_path(bench)
        revision = git_revision() or "unknown"
        if keep is not None:
            if not keep.is_dir():
                raise InputError(f"--keep {keep}: there is no such folder; create it first")
            if revision.endswith("-dirty"):
                raise InputError("--keep needs a committed tree: results of changed files would be taken for its own")
        others = [(Path(text.partition("#")[0]), text.partition("#")[2]) for text in beside or []]
        benches = [(path, _chosen("--only", only)), *((file, _chosen("--beside", text)) for file, text in others)]
        for file, chosen in benches:
            _emulated(file, chosen)
            if compiled:
                check_compiled(load_bench(file), "realtime")  # emulated time has descriptors here
        with progress_bar(console(), task_name(), BarColumn(), TimeElapsedColumn()) as progress:
            task = progress.add_task("starting", total=len(POINTS) * seeds * (len(PHASES) + 1) * len(benches))
            campaigns = (
                run_campaign(
                    file,
                    chosen,
                    seeds=range(seed, seed + seeds),
                    n_pairs=pairs if file == path else 0,
                    jobs=jobs,
                    progress=lambda text: progress.update(task, advance=1, description=text),
                    keep=keep,
                    revision=revision,
                    compiled=compiled,
                )
                for file, chosen in benches
            )
            rows = next(campaigns)
            others_rows = [] if is_stopped() else list(takewhile(lambda _: not is_stopped(), campaigns))
            besides = [Beside(f"{f}", text, more) for (f, text), more in zip(others, others_rows, strict=False)]
            bounds = drift_bounds(path, rows) if out is not None and not is_stopped() else []
        total = totals(rows)
        outputs = Outputs()
        if out is not None and not is_stopped():
            asked = "".join(f" --beside {shlex.quote(text)}" for text in beside or [])
            kind = " --compiled" if compiled else ""
            command = f"micron faults --seeds {seeds} --seed {seed} --pairs {pairs}{kind}{asked} --out {out}"
            with outputs.part("page"):
                write_result(out, markdown(rows, command, revision_and_day(), bounds, besides))
        if json_file != "-":
            with outputs.part("table"):
                _print(rows, total)
        more = [
            {"bench": b.bench, "only": b.chosen, "rows": [r.as_dict() for r in b.rows], "totals": totals(b.rows)}
            for b in besides
        ]
        result = {"format": 1, "rows": [row.as_dict() for row in rows], "totals": total}
        with outputs.part("JSON"):
            write_json({**result, "beside": more} if more else result, json_file)
        outputs.finish()
    for figures in (total, *(totals(b.rows) for b in besides)):
        wrong = figures["unsafe_outputs"] + figures["uncounted_samples"] + figures["wrong_messages"]
        if wrong or figures["as_expected"] < figures["runs"]:
            raise typer.Exit(1)


def _chosen(option: str, text: str) -> list[Fault]:
    from tools.research.faults.catalogue import faults as catalogue

    chosen = [fault for fault in catalogue() if text.lower() in fault.name.lower()]
    if not chosen:
        raise InputError(
            f"{option} {text!r}: no fault is called so; names begin with serial, daq, sensor, output bus ..."
        )
    return chosen


def _emulated(path: Path, chosen: Sequence[Fault]) -> None:
    bench = load_bench(path)
    description = bench.description
    for name in named_files(description):
        allow_name(bench.resolve(name))  # the campaign's copies of the bench lie elsewhere
    daq = description.device.get("daq")
    if daq is None or daq.driver != "di4108" or "piezo" not in description.device:
        raise InputError(
            f"{path}: the campaign breaks an instrument with a DI-4108 named 'daq' and an amplifier named 'piezo'; "
            f"this bench has {', '.join(description.device)}"
        )
    names = {*description.device, *description.bus}
    for fault in chosen:
        if (part := fault.part_of_bench) and part not in names:
            raise InputError(f"{path}: '{fault.name}' breaks '{part}', which is not on this bench; choose with --only")
    if len(description.emulated_buses()) < len(description.bus):
        raise InputError(
            f"{path}: the campaign runs on emulated benches only; use a bench of sim:// buses, or one fault at a time "
            "on a real one: micron run --inject"
        )


def _print(rows: list, total: dict) -> None:
    table = Table("fault", "hand", "answer", "known ms", "neutral ms", "tip um", "as expected", title="Faults")
    for row in rows:
        if row.fault.is_pair and row.is_good:
            continue
        d = row.as_dict()
        known, neutral = d["detect_ms"]["max"], d["answer_ms"]["max"]
        table.add_row(
            row.fault.name,
            row.point,
            row.answer,
            "-" if known is None else f"{known:.1f}",
            "NOT confirmed" if d["not_confirmed"] else "-" if neutral is None else f"{neutral:.1f}",
            f"{d['tip_error_um_max']:.1f}",
            f"{row.as_expected}/{row.seeds}",
        )
    data_console().print(table)
    for name, value in total.items():
        data_console().print(f"{name.replace('_', ' ')}: {value}")
