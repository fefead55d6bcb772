"""Implements ``micron mismatch``: it finds where simulation and recording differ, and which physics is missing."""

from __future__ import annotations

import os
import re
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tools.cli.bench_option import bench_path
from tools.cli.common import (
    Exit,
    JsonOption,
    check_picture,
    clear_errors,
    console,
    data_console,
    print_error,
    print_note,
)
from tools.cli.mismatch_heal import heal
from tools.cli.mismatch_plan import plan, read_report
from tools.cli.mismatch_watch import watch
from tools.cli.trust import OutsideOption, TrustOption, decide_on
from tools.errors import InputError, RecordingError
from tools.interrupt import keep_what_is_there, need_some
from tools.output import Outputs, check_folder, check_names, check_writable, write_json, write_text_atomic
from tools.terminal import progress_bar, table_of, task_name

if TYPE_CHECKING:
    from tools.mismatch.engine.report import Report
    from tools.mismatch.new import NewRecording
    from tools.mismatch.recording import Array, Recording

# each command imports its modules itself, so that `micron --help` does not wait for the engine

app = typer.Typer(help="Find where a simulation and a recording differ, and which physics the simulation lacks.")

RecordingArgument = Annotated[
    Path, typer.Argument(metavar="RECORDING", help="A recording (folder or .toml), or a folder of recordings.")
]
RecordingsArgument = Annotated[
    list[Path],
    typer.Argument(
        metavar="RECORDING...", help="A recording (folder or .toml) or a folder of recordings; several with --together."
    ),
]
SeedOption = Annotated[
    int, typer.Option(min=0, help="Seed of the search; the same recording and seed give the same answer.")
]
MOST_NAMED = 12
"""Largest number of unused columns that are named."""
MOST_SHARED = 1_000_000
"""Samples above which one process of this machine works alone: each further one would hold a gigabyte of columns."""


def diagnose(
    *,
    recordings: RecordingsArgument,
    json_file: JsonOption = None,
    html: Annotated[Path | None, typer.Option(metavar="FILE", help="Self-contained HTML report with pictures.")] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Folder for report.json and report.html of each recording.")
    ] = None,
    held_out: Annotated[
        float, typer.Option(min=0.1, max=0.6, help="Share of the record that no fit sees, unless it brings a split.")
    ] = 0.3,
    seed: SeedOption = 0,
    jobs: Annotated[int | None, typer.Option(min=1, help="Number of processes; default: one per core.")] = None,
    dask: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="With a folder or --together: run on this Dask cluster (extra 'dask')."),
    ] = None,
    trust: TrustOption = False,
    allow_outside: OutsideOption = False,
    together: Annotated[
        bool,
        typer.Option("--together", help="Give all recordings of one system one diagnosis, and report what differs."),
    ] = False,
    per_recording: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME[.PARAMETER]", help="With --together: free in each recording; may be repeated."),
    ] = None,
) -> None:
    """Locate the mismatch, name the physics that is missing, fit it, and show the fit improve on unseen data.

    With --together several recordings of one system get one answer: one set of effects for all, scored on recordings
    that the fit left out, and what changes between them (docs/many-recordings.md).

    'micron mismatch physics' lists all effects that can be named.

    Example: micron mismatch diagnose recordings/stack --html stack.html --json stack.json
    """
    with clear_errors():
        check_writable(json_file, html, reads=recordings)
        check_folder(out)
        processes = jobs or os.cpu_count() or 1
        if together:
            from tools.mismatch.together import load_together, recordings_of

            decide_on([*recordings_of(recordings).values()], trust, allow_outside)
            joined = load_together(recordings, per_recording or [])
            _show(_diagnose_together(joined, held_out, seed, processes, dask), json_file, html, out)
            return
        if per_recording:
            raise InputError("--per-recording needs --together: it says what differs between recordings")
        if len(recordings) > 1:
            raise InputError(
                f"{len(recordings)} recordings: add --together if they are of one system, or name one folder of them"
            )
        recording = recordings[0]
        decide_on([recording], trust, allow_outside)
        from tools.mismatch.batch import is_folder_of_recordings

        if is_folder_of_recordings(recording):
            if html is not None:
                raise InputError(f"--html is for one recording; {recording} is a folder of them: use --out FOLDER")
            _diagnose_folder(recording, json_file, out, held_out=held_out, seed=seed, jobs=processes, dask=dask)
            return
        if dask is not None:
            raise InputError("--dask spreads a folder of recordings, or several --together; for one use --jobs")
        report = _diagnose_one(recording, held_out, seed, processes)
        _show(report, json_file, html, out)


def _diagnose_together(joined: Recording, held_out: float, seed: int, jobs: int, dask: str | None) -> Report:
    if dask is None:
        return _diagnose_one(joined, held_out, seed, jobs)
    from tools.mismatch.batch import on_cluster

    with on_cluster(dask) as threads:
        # with one job the engine would work here
        return _diagnose_one(joined, held_out, seed, max(2, threads), here=False)


def _diagnose_one(recording: Path | Recording, held_out: float, seed: int, jobs: int, *, here: bool = True) -> Report:
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn

    from tools.mismatch.engine.checks import questions
    from tools.mismatch.infer import diagnose
    from tools.mismatch.recording_load import load

    loaded = load(recording) if isinstance(recording, Path) else recording
    for note in (*loaded.warnings, *([] if loaded.parts else questions(loaded))):
        print_note(note)
    columns = (task_name(), BarColumn(), TextColumn("{task.completed}/{task.total}"), TimeElapsedColumn())
    with progress_bar(console(), *columns) as progress:
        bar = progress.add_task("noise and base parameters", total=None)

        def show(what: str, done: int, total: int) -> None:
            progress.update(bar, description=what, completed=done, total=total)

        shared = 1 if here and loaded.n > MOST_SHARED else jobs
        return diagnose(loaded, held_out=held_out, seed=seed, jobs=shared, progress=show)


def _show(report: Report, json_file: str | None, html: Path | None, out: Path | None) -> None:
    from tools.mismatch.report.terminal import print_report

    outputs = Outputs()
    with outputs.part("table"):
        print_report(report, data_console(json_file))
    with outputs.part("JSON"):
        write_json(report.to_json(), json_file)
    if html is not None or out is not None:
        from tools.mismatch.batch import write_reports
        from tools.mismatch.report.page import html_page

        with outputs.part("page"):
            page = html_page(report)
            if html is not None:
                write_text_atomic(html, page)
            if out is not None:
                write_reports(report, out, page)
    outputs.finish()


def _diagnose_folder(
    folder: Path, json_file: str | None, out: Path | None, *, held_out: float, seed: int, jobs: int, dask: str | None,
) -> None:  # fmt: skip
    from rich.progress import BarColumn, MofNCompleteColumn, TimeRemainingColumn

    from tools.mismatch import batch
    from tools.mismatch.report.terminal import batch_report

    work = batch.jobs_for(batch.find(folder), out, held_out, seed)
    stream = batch.run_here(work, jobs) if dask is None else batch.run_on_dask(work, dask)
    rows: list[batch.Row] = []
    with progress_bar(console(), task_name(), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()) as progress:
        bar = progress.add_task("recordings", total=len(work))
        with keep_what_is_there():
            for row in stream:
                rows.append(row)
                progress.update(bar, advance=1, description=row.name)
    need_some(rows)
    rows.sort(key=lambda row: row.name)
    data_console(json_file).print(batch_report([row.cells for row in rows]))
    write_json(batch.to_json(folder, rows), json_file)
    bad = [row for row in rows if row.error]
    if bad:
        print_error(f"{len(bad)} of {len(rows)} recordings have no report")
        raise typer.Exit(Exit.BAD_INPUT if all(row.bad_input for row in bad) else Exit.FAILED)


def new(
    *,
    data: Annotated[Path, typer.Argument(metavar="DATA", help="A data file: .csv, .txt, .npz, .mat and others.")],
    twin: Annotated[str, typer.Option("--twin", metavar="KIND", help="The kind of twin; default: guessed.")] = "",
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE.toml", help="Default: recording.toml; in the folder of DATA.")
    ] = None,
    rate: Annotated[
        float | None, typer.Option(metavar="HZ", help="Rate of the samples, in place of a column of time.")
    ] = None,
    resample: Annotated[
        float | None, typer.Option(metavar="HZ", help="Bring the columns to even steps at this rate.")
    ] = None,
    cut: Annotated[bool, typer.Option("--cut", help="Cut at gaps into runs that are diagnosed together.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Overwrite an existing file.")] = False,
    json_file: JsonOption = None,
) -> None:
    """Make a recording.toml for a data file: guess time, roles, units and the twin, and draw the columns.

    What it could not know is printed and stands in the file as a comment. When nothing is unknown, 'micron mismatch
    diagnose' runs on it at once.

    Example: micron mismatch new rig/data.csv
    """
    with clear_errors():
        check_names(out)
        check_writable(json_file, reads=[data])
        for option, hertz in (("--rate", rate), ("--resample", resample)):
            if hertz is not None and not 0.0 < hertz < 1e9:
                raise InputError(f"{option} {hertz:g}: must be samples per second, above 0 and below 1e9")
        from tools.mismatch.new import new_recording

        made = new_recording(data, out, twin, rate_hz=rate, resample_hz=resample, cut=cut, force=force)
        _show_new(made, json_file)


def _show_new(made: NewRecording, json_file: str | None) -> None:
    headings = ("column", "role", "signal", "unit", "from", "to")
    table = table_of(None, *headings, left=6, box=None, pad_edge=False)
    for c in made.guess.columns:
        signal = c.signal if c.role in ("input", "output", "context") else ""
        table.add_row(c.name, c.role or "not used", signal, c.unit or "?", f"{min(c.low):.4g}", f"{max(c.high):.4g}")
    data_console(json_file).print(table)
    write_json(made.to_json(), json_file)
    for heading, lines in (("assumed", made.guess.assumed), ("note", made.guess.notes)):
        for one in lines:
            console().print(f"{heading}: {one}", soft_wrap=True)
    rate = made.to_json()["rate_hz"]
    at = f" at {rate:.6g} Hz" if rate else ""
    runs = f" in {made.stretch.kept} runs" if made.stretch is not None and made.stretch.kept > 1 else ""
    console().print(
        f"{made.path}: {made.to_json()['samples']} samples{at}{runs}, twin {made.guess.kind or 'unknown'};"
        f" the columns are drawn in {made.picture}",
        soft_wrap=True,
    )
    path = shlex.quote(str(made.path))
    write = f"complete in {path} what could not be known" if made.guess.unknown else f"write what you know into {path}"
    console().print(f"next: {write}, then: micron mismatch diagnose {path}", soft_wrap=True)
    for one in made.guess.unknown:
        console().print(f"  {one}", soft_wrap=True)


def physics(
    names: Annotated[list[str] | None, typer.Argument(metavar="NAME", help="Effects to print; default: all.")] = None,
    json_file: JsonOption = None,
) -> None:
    """List the effects of the vocabulary with formula, parameters, source, and the excitation that shows them.

    Example: micron mismatch physics creep backlash
    """
    with clear_errors():
        check_writable(json_file)
        from tools.mismatch.report.vocabulary import entries, print_vocabulary, to_json

        effects = entries(names or ())
        if json_file != "-":
            print_vocabulary(effects, data_console())
        write_json(to_json(effects), json_file)


def cut(
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="A recording (folder or .toml).")],
    out: Annotated[Path, typer.Option("--out", metavar="FOLDER", help="The new recording.")],
    start: Annotated[float | None, typer.Option(metavar="S", help="Keep nothing before this time.")] = None,
    stop: Annotated[float | None, typer.Option(metavar="S", help="Keep nothing from this time on.")] = None,
    every: Annotated[bool, typer.Option("--every", help="Keep every stretch as a run of its own.")] = False,
) -> None:
    """Keep the longest stretch without gaps, on a uniform clock, as a recording of its own.

    With --every all stretches are kept, one behind the other; a plant with states starts afresh in each.

    Example: micron mismatch cut rec --out whole
    """
    with clear_errors():
        check_folder(out)
        from tools.mismatch.cut import cut as cut_recording

        kept = cut_recording(recording, out, start, stop, every)
        stretches = "stretch" if kept.parts == 1 else "stretches"
        console().print(
            f"{kept.samples} samples at {kept.rate_hz:.6g} Hz, {kept.start_s:g} to {kept.stop_s:g} s of the original"
            f" ({kept.kept} of {kept.parts} {stretches}), {kept.filled} samples filled: {out}",
            soft_wrap=True,
        )


def apply(
    *,
    recording: RecordingArgument,
    report: Annotated[
        Path, typer.Argument(metavar="REPORT.json", help="Report that 'diagnose --json' wrote for the recording.")
    ],
    out: Annotated[
        Path, typer.Option("--out", metavar="FILE", help="The corrected twin: .toml, .py, .fmu, or .csv for columns.")
    ],
    bench: Annotated[
        Path | None, typer.Option(metavar="FILE|NAME", help="Put a piezo_stack twin on this emulated bench, too.")
    ] = None,
    bench_out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The bench with the twin; default: bench.toml beside the twin.")
    ] = None,
    trust: TrustOption = False,
    allow_outside: OutsideOption = False,
) -> None:
    """Write the corrected twin: base parameters re-fitted beside the effects, and the effects themselves.

    The ending says the form: .toml is taken by recordings (file = "TWIN.toml" in the twin table) and benches
    (twin = "TWIN.toml" in emulation); .py needs numpy alone; .fmu is an FMI 2.0 co-simulation; .csv holds the
    simulated columns. 'micron mismatch simulate' runs the first three again.

    Example: micron mismatch apply rec rec.json --out twin.py
    """
    with clear_errors():
        check_names(out, bench_out)
        if bench_out is not None and bench is None:
            raise InputError("--bench-out names a copy of a bench; name the bench with --bench")
        from tools.mismatch.export.write import check_format, write_twin

        check_format(out)
        if bench is not None and out.suffix.lower() != ".toml":
            raise InputError(f"--bench takes a twin file; name one that ends in .toml with --out, not {out.name}")
        copy = bench_out or out.with_name("bench.toml")
        decide_on([recording], trust, allow_outside)
        check_writable(out, *([] if bench is None else [copy]), reads=[recording, report, bench])
        original = None
        if bench is not None:
            from hal.bench import load_bench

            bench = bench_path(bench)
            original = load_bench(bench)
            if copy.exists() and copy.samefile(bench):
                raise InputError(f"{copy}: is the bench itself; name another file with --bench-out")
        from tools.mismatch.apply import corrected_twin

        body = read_report(report)
        try:
            twin = corrected_twin(recording, body)
        except RecordingError:
            raise
        except InputError as error:
            raise InputError(f"{report}: {error}") from error
        if original is not None and twin.kind != "piezo_stack":
            raise InputError(
                f"{bench}: a bench runs twins of kind piezo_stack, not of kind {twin.kind}; leave --bench out"
            )
        write_twin(twin, body, out)
        for note in twin.notes:
            print_note(note)
        carried = ", ".join(twin.effects) or "no effects"
        console().print(f"{out}: {twin.kind} with {carried}")
        if original is not None:
            from tools.bench.bench_copy import with_twin

            with_twin(original, out, copy)
            console().print(f"{copy}: {original.path} with it; try: micron run --bench {copy}", soft_wrap=True)


def simulate(
    twin: Annotated[
        Path,
        typer.Argument(
            metavar="TWIN|RECORDING",
            help="Corrected twin that 'apply' wrote: .toml, .py or .fmu; or the recording, whose own twin is then run.",
        ),
    ],
    recording: Annotated[
        Path | None, typer.Argument(metavar="[RECORDING]", help="A recording (folder or .toml) for the corrected twin.")
    ] = None,
    *,
    data: Annotated[
        Path | None,
        typer.Option("--data", metavar="FILE", help="Another data file with the columns of the recording, say a test."),
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="FILE.csv", help="The simulated columns.")] = None,
    image: Annotated[
        Path | None, typer.Option("--picture", metavar="FILE", help="Picture of recorded, simulated and residual.")
    ] = None,
    json_file: JsonOption = None,
    trust: TrustOption = False,
    allow_outside: OutsideOption = False,
) -> None:
    """Run a twin freely over a whole recording and print how far it is from what was recorded.

    Example: micron mismatch simulate twin.py rec --out simulated.csv

    The recording's own twin, and what was read of the recording: micron mismatch simulate rec --picture rec.png
    On another run of the machine, in columns of the same names: micron mismatch simulate rec --data test.csv
    """
    with clear_errors():
        check_writable(out, image, json_file, reads=[twin, recording, data])
        check_picture(image)
        decide_on([twin, recording or twin], trust, allow_outside)
        from tools.mismatch.export.picture import save_run
        from tools.mismatch.export.run import Residual, as_read, residuals, simulate_file, simulate_own, start_of
        from tools.mismatch.export.write import columns
        from tools.mismatch.recording_load import columns_left_out, load
        from tools.mismatch.simulate_bounds import run_bounded

        loaded = load(recording or twin, data)

        def run() -> dict[str, Array]:
            return simulate_own(loaded) if recording is None else simulate_file(twin, loaded)

        simulated = run_bounded(twin, loaded, run)  # a fault of the twin is told alone
        for line in [*as_read(loaded), start_of(loaded) if recording is None else ""]:
            if line:
                _print_read(line)
        left_out = columns_left_out(recording or twin)
        if left_out:
            more = f" and {len(left_out) - MOST_NAMED} more" if len(left_out) > MOST_NAMED else ""
            console().print(
                f"columns not used: {', '.join(left_out[:MOST_NAMED])}{more}", highlight=False, markup=False
            )
        rows: list[Residual] = residuals(loaded, simulated)
        if out is not None:
            write_text_atomic(out, columns(loaded, simulated))
        if image is not None:
            save_run(loaded, simulated, image)
        say = data_console(json_file)
        for row in rows:
            say.print(row.text(), highlight=False, soft_wrap=True)
        write_json({"format": 1, "twin": str(twin), "outputs": [row.as_dict() for row in rows]}, json_file)


def _print_read(line: str) -> None:
    """Print a line of what was read. A list is broken between its items only: a name stays beside its value."""
    out = console()
    if line.startswith("note: "):
        out.print(line)
        return
    row, *others = re.split(r"(?<=,) (?![^()]*\))", line)  # a comma in brackets belongs to its item
    for item in others:
        if len(row) + 1 + len(item) > out.width:
            out.print(row, soft_wrap=True)
            row = f"  {item}"
        else:
            row += f" {item}"
    out.print(row, soft_wrap=True)


for _command in (new, diagnose, apply, simulate, plan, watch, heal, cut, physics):  # in the order of their use
    app.command()(_command)
