"""Implements ``micron endoscope``: a synthetic user plays the targeting experiment, and its tables are printed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import track

from tools.cli.bench_option import bench_path
from tools.cli.common import Exit, JsonOption, check_recording_name, clear_errors, console, data_console
from tools.errors import InputError
from tools.output import check_writable, write_json, write_text_atomic
from tools.terminal import table_of

endoscope = typer.Typer(
    help="Let a synthetic user steer the endoscope's field of view with the motion card (Erat 2018, chapter 6)."
)

MappingOption = Annotated[str, typer.Option("--mapping", help="Mapping: position or speed.")]
GainOption = Annotated[
    float, typer.Option(min=0.01, max=1000.0, help="Gain in pixels per degree, or pixels/s per degree.")
]
ResponseOption = Annotated[float, typer.Option("--response", min=0.0, max=60.0, help="Response time constant, in s.")]
SeedOption = Annotated[int, typer.Option(min=0, help="Seed of targets and user.")]


def mapping_of(name: str) -> Any:
    if name not in ("position", "speed"):
        raise InputError(f"--mapping {name}: it is position or speed")
    return name


def default_bench() -> Path:
    """The emulated endoscope bench that ships with the package."""
    import benches

    return Path(benches.__file__).with_name("endoscope.toml")


@endoscope.command("play")
def play_command(
    user: Annotated[str, typer.Option(help="Name of the user in the report.")] = "synthetic",
    mapping: MappingOption = "position",
    gain: GainOption = 8.0,
    response: ResponseOption = 0.25,
    targets: Annotated[int, typer.Option(min=1, max=100)] = 5,
    tolerance: Annotated[
        float, typer.Option(min=0.1, max=100.0, help="Largest distance from a target, in pixels.")
    ] = 9.0,
    seed: SeedOption = 1,
    bench: Annotated[
        Path | None, typer.Option("--bench", metavar="FILE|NAME", help="Emulated bench; default: endoscope.")
    ] = None,
    direct: Annotated[
        bool, typer.Option("--direct", help="Feed angles straight into the game, without a bench.")
    ] = False,
    limit: Annotated[float, typer.Option(min=1.0, max=3600.0, help="Give up after so many seconds.")] = 300.0,
    record: Annotated[Path | None, typer.Option(metavar="FILE", help="Record the run (.mcap).")] = None,
    report: Annotated[Path | None, typer.Option(metavar="FILE", help="Report file of this user (CSV).")] = None,
    json_file: JsonOption = None,
) -> None:
    """Let a synthetic user steer the endoscope's field of view with the emulated motion card until all targets are
    reached.

    The user turns the card and presses its button (Erat 2018, chapter 6), in virtual time.

    Example: micron endoscope play --mapping speed --response 1 --report out/user.csv
    """
    from firmware_py.endoscope.control import ControlConfig
    from firmware_py.endoscope.report import report_csv
    from firmware_py.endoscope.targets import GameConfig
    from tools.research.endoscope.play import play, play_on_bench
    from tools.research.endoscope.user import UserConfig

    with clear_errors():
        check_writable(json_file, record, report)
        check_recording_name(record)
        if direct and (record or bench):
            raise InputError("--direct runs without a bench; leave out --bench and --record")
        control = ControlConfig(mapping=mapping_of(mapping), gain=gain, response_s=response)
        game = GameConfig(control=control, targets=targets, tolerance_px=tolerance, seed=seed)
        person = UserConfig(name=user, seed=seed)
        if direct:
            result: dict[str, Any] = {"format": 1, "experiment": play(person, game, limit)}
            healthy = True
        else:
            with console().status("the user plays on the emulated bench"):
                outcome = play_on_bench(
                    default_bench() if bench is None else bench_path(bench),
                    person,
                    game,
                    seed=seed,
                    record=record,
                    limit_s=limit,
                )
            outcome.pop("attitudes")
            result = outcome
            healthy = outcome["samples"]["lost"] == 0 and outcome["recorder"]["dropped"] == 0
        result["user"] = user
        done = result["experiment"]
        _show(user, done)
        if report is not None:
            write_text_atomic(report, report_csv(user, done))
            console().print(f"report: {report}")
        write_json(result, json_file)
        if not done["done"]:
            ended = result.get("safe_state", {"normal": True})
            why = f"gave up after {limit:g} s (--limit)" if ended["normal"] else f"ended: {ended['reason']}"
            console().print(why, style="yellow", soft_wrap=True)
            raise typer.Exit(Exit.FAILED)
        if not healthy:
            raise typer.Exit(Exit.DATA_LOST)


def _show(user: str, result: dict[str, Any]) -> None:
    time = f" in {result['elapsed_s']:.1f} s" if result["reached"] else ""
    title = f"{user}: {result['reached']} of {result['targets']} targets{time}, "
    title += f"{result['clicks']} clicks, {result['mapping']} mapping"
    table = table_of(title, "target", "time (s)", "clicks", "psi (deg)", "theta (deg)", left=0)
    for row in result["rows"]:
        psi, theta = (f"{row[f'{a}_min_deg']:.1f} .. {row[f'{a}_max_deg']:.1f}" for a in ("psi", "theta"))
        table.add_row(str(row["target"]), f"{row['elapsed_s']:.1f}", str(row["clicks"]), psi, theta)
    console().print(table)


@endoscope.command("tables")
def tables(
    gain: GainOption = 8.0,
    experiments: Annotated[int, typer.Option(min=1, max=100, help="Users per cell of the table.")] = 5,
    seed: SeedOption = 1,
    json_file: JsonOption = None,
) -> None:
    """Measure the elapsed time for both mappings and four response times with a synthetic user (Erat 2018, Tables 6.1
    and 6.2).

    Example: micron endoscope tables --json out/mapping.json
    """
    from tools.research.endoscope.experiment import RESPONSES_S, run_cell
    from tools.research.endoscope.user import UserConfig

    with clear_errors():
        check_writable(json_file)
        person = UserConfig(seed=seed)
        jobs = [(mapping, tau) for mapping in ("position", "speed") for tau in RESPONSES_S]
        cells = [
            run_cell(mapping_of(mapping), tau, person, gain=gain, experiments=experiments)
            for mapping, tau in track(jobs, "playing", console=console(), transient=True)
        ]
        title = f"synthetic user, K = {gain:g}, {experiments} experiments a cell"
        headings = ("mapping", "tau (s)", "time (s)", "mean (s)", "clicks", "psi, theta (deg)")
        grid = table_of(title, *headings, left=0)
        for cell in cells:
            times = " ".join(f"{v:.0f}" for v in cell.elapsed_s)
            psi, theta = cell.rotation_deg
            clicks = f"{sum(cell.clicks) / len(cell.clicks):.1f}"
            grid.add_row(
                cell.mapping, f"{cell.response_s:g}", times, f"{cell.mean_s:.1f}", clicks, f"{psi:.1f}, {theta:.1f}"
            )
        data_console().print(grid)
        rows = [
            {
                "mapping": cell.mapping,
                "response_s": cell.response_s,
                "elapsed_s": list(cell.elapsed_s),
                "mean_s": cell.mean_s,
                "clicks": list(cell.clicks),
                "rotation_deg": list(cell.rotation_deg),
                "done": cell.done,
            }
            for cell in cells
        ]
        write_json({"format": 1, "gain": gain, "rows": rows}, json_file)
        if not all(cell.done for cell in cells):
            raise typer.Exit(Exit.FAILED)
