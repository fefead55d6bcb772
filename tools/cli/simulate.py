"""Implements ``micron simulate``: world and firmware run in one compiled loop without wires, for sweeps."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn

from hal.bench import load_bench
from tools.cli.bench_option import BenchOption, HandOption, ScaleOption, SeedOption, bench_path
from tools.cli.common import JsonOption, check_picture, clear_errors, console
from tools.cli.run import complete_result
from tools.errors import InputError
from tools.output import Outputs, check_writable, write_json
from tools.terminal import progress_bar

if TYPE_CHECKING:
    from tools.closed_loop.simulate import SimulatedRun


def simulate_command(
    *,
    bench: BenchOption = None,
    seconds: Annotated[float, typer.Option(min=3.0, max=86_400.0, help="Simulated time after arming.")] = 60.0,
    hand: HandOption = None,
    scale: ScaleOption = None,
    delay_us: Annotated[
        float | None, typer.Option(help="Delay from scan to command, in us; the default is that of the default bench.")
    ] = None,
    seed: SeedOption = None,
    json_file: JsonOption = None,
    image: Annotated[
        Path | None, typer.Option("--picture", metavar="FILE", help="Picture (PNG) before and after.")
    ] = None,
) -> None:
    """Simulate the closed loop without wires, tens of times faster than real time; the same figures as micron run.

    Left out: supervision, faults, and the jitter of the bus (a command is late by the constant --delay-us).

    Example: micron simulate --seconds 60 --json -
    """
    from tools.closed_loop.simulate import COMMAND_DELAY_S, simulate
    from tools.reports.run_report import headline, picture, save_picture, spectrum_table, tremor_table

    delay_s = COMMAND_DELAY_S if delay_us is None else 1e-6 * delay_us
    with clear_errors():
        check_writable(json_file, image, reads=[bench, hand])
        check_picture(image, (".png",))
        if scale is not None and hand is None:
            raise InputError("--scale belongs to --hand FILE; give both or neither")
        file = bench_path(bench)
        opened = load_bench(file)
        started_s = time.process_time()
        with progress_bar(console(), TextColumn("simulating"), BarColumn(), TimeRemainingColumn()) as progress:
            bar = progress.add_task("simulate", total=seconds)
            run = simulate(
                opened, seconds, seed=seed, hand_file=hand, hand_scale=scale, delay_s=delay_s,
                on_time=lambda done_s: progress.update(bar, completed=done_s),
            )  # fmt: skip
        took_s = time.process_time() - started_s
        result = complete_result(_outcome(run, file, seconds, delay_s), run.truth)
        outputs, people = Outputs(), console()
        with outputs.part("table"):
            people.print(tremor_table(result))
            if result["tremor"]["spectrum"]["hz"]:
                people.print(spectrum_table(result), "", sep="\n")
            people.print(f"commands clipped: {run.clipped}; {seconds / took_s:.0f} x real time on one core")
            people.print(headline(result), style="bold")
        with outputs.part("JSON"):
            write_json(result, json_file)
        if image is not None:
            with outputs.part("picture"):
                save_picture(picture(run.truth, result), image)
        outputs.finish()


def _outcome(run: SimulatedRun, bench: Path, seconds: float, delay_s: float) -> dict[str, object]:
    return {
        "command": "simulate",
        "bench": str(bench),
        "seconds": seconds,
        "command_delay_us": 1e6 * delay_s,
        "started_ns": run.started_ns,
        "armed_ns": run.armed_ns,
        "safe_ns": run.safe_ns,
        "commands": {"clipped": run.clipped},
    }
