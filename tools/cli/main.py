"""Entry point: the list of commands, ``--version``, and nothing else."""

from __future__ import annotations

from importlib.metadata import version
from typing import Annotated

import typer

from tools.cli import (
    bench,
    calibrate,
    diagnose,
    doctor,
    endoscope,
    faults,
    hands,
    imu,
    manipulator,
    mismatch,
    noise,
    placement,
    read,
    recordings,
    replay,
    reproduce,
    run,
    sensing,
    simulate,
    soak,
    tremor,
)

app = typer.Typer(
    name="micron",
    help="Firmware and bench of a handheld instrument that cancels tremor. Start with: micron run",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"micron {version('micron-bench')}")
        raise typer.Exit


@app.callback()
def options(
    show_version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Firmware and bench of a handheld instrument that cancels tremor. Start with: micron run"""


app.command("run")(run.run)
app.command("simulate")(simulate.simulate_command)
app.command("bench")(bench.bench)
app.command("replay")(replay.replay)
app.command("doctor")(doctor.doctor)
app.command("hands")(hands.hands)
app.command("faults")(faults.faults)
app.command("soak")(soak.soak)
app.command("reproduce")(reproduce.reproduce)
app.command("noise")(noise.noise)
app.command("placement")(placement.placement)
app.command("recover")(recordings.recover)
app.command("export")(recordings.export)
app.command("scan")(diagnose.scan)
app.command("read")(read.read)
app.command("scope")(diagnose.scope)
app.command("latency")(diagnose.latency)
app.command("ramp")(diagnose.ramp)
app.command("capture")(diagnose.capture)
app.add_typer(diagnose.can, name="can")
app.add_typer(diagnose.golden, name="golden")
app.add_typer(diagnose.log, name="log")
app.add_typer(calibrate.calibrate, name="calibrate")
app.add_typer(endoscope.endoscope, name="endoscope")
app.add_typer(imu.imu, name="imu")
app.add_typer(manipulator.app, name="manipulator")
app.add_typer(mismatch.app, name="mismatch")
app.add_typer(sensing.app, name="sensing")
app.add_typer(tremor.app, name="tremor")


def main() -> None:
    """What the ``micron`` script calls."""
    app()


if __name__ == "__main__":
    main()
