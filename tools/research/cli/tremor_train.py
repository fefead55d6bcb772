"""Implements ``micron tremor train``: it trains a cascade network on recorded hands."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.table import Table

from tools.cli.common import JsonOption, clear_errors, console, data_console
from tools.errors import InputError
from tools.output import check_writable, write_json, write_text_atomic

if TYPE_CHECKING:
    from tools.research.tremor.cascade_data import Subject
    from tools.research.tremor.cascade_training import Array


def train(
    recordings: Annotated[
        list[str], typer.Argument(metavar="RECORDING[#NAME]...", help="Gyroscope recordings of hands.")
    ],
    out: Annotated[Path, typer.Option(metavar="FILE", help="File for the weights (JSON).")] = Path("out/cascade.json"),
    weights: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Test the network of this file instead of training one.")
    ] = None,
    leave_out: Annotated[
        list[str] | None, typer.Option(metavar="PERSON", help="Subject that is held out for the test; may be repeated.")
    ] = None,
    target: Annotated[
        Literal["voluntary", "error"], typer.Option(help="Output of the network: NN_vm or NN_err.")
    ] = "voluntary",
    window: Annotated[
        int | None, typer.Option(min=2, max=400, help="Number of inputs; without it several windows are tried.")
    ] = None,
    spacing: Annotated[int, typer.Option(min=1, max=20, help="Samples of 4 ms between inputs.")] = 1,
    units: Annotated[int, typer.Option(min=0, max=20, help="Largest number of hidden units.")] = 4,
    centred: Annotated[
        bool, typer.Option(help="Subtract the mean of the window, so that the hand's position does not matter.")
    ] = True,
    error_above_hz: Annotated[
        float, typer.Option(min=0.1, max=5.0, help="Definition of the error (Ang 2004, sec. 5.3.3).")
    ] = 2.0,
    seed: Annotated[int, typer.Option(min=0)] = 1,
    json_file: JsonOption = None,
) -> None:
    """Train a cascade network on one file of each person, test it on the other files, write its weights.

    Example: micron tremor train ../shared/data/tremor_mouse_lsm9ds1 --leave-out mouse23 --out out/cascade.json
    """
    from tools.research.tremor.cascade_data import Making, subjects, voluntary
    from tools.research.tremor.cascade_file import network_text
    from tools.research.tremor.cascade_study import TEST_SEED, WINDOWS, mean_percent, score, search
    from tools.research.tremor.cascade_training import Training
    from tools.research.tremor.signals import load_signals

    with clear_errors():
        check_writable(json_file, out)
        making = Making(error_above_hz=error_above_hz)
        signals = [s for r in recordings for s in load_signals(r) if s.quantity == "angular rate"]
        if not signals:
            raise InputError(f"{', '.join(recordings)}: no gyroscope recording; training integrates angular rate once")
        people = subjects(signals, making)
        if weights is not None:
            _test(weights, people, voluntary(making, TEST_SEED), json_file)
            return
        known = [p.name for p in people]
        for name in leave_out or []:
            if name not in known:
                raise InputError(f"--leave-out {name}: no such person; there are: {', '.join(known)}")
        learning = [p for p in people if p.name not in (leave_out or [])]
        if not learning:
            raise InputError("--leave-out leaves nobody to train on")
        how = Training(units=units, target=target, centred=centred, seed=seed)
        windows = WINDOWS if window is None else ((window, spacing),)
        names = ", ".join(p.name for p in learning)
        note = f"trained by micron tremor train on {names}; error above {error_above_hz:g} Hz"
        with console().status("training"):
            try:
                trained = search([p.errors[0] for p in learning], making, replace(how), windows, 2, note)
            except ValueError as error:
                raise InputError(f"{error}; a smaller --window or --spacing fits") from error
        wanted = voluntary(making, TEST_SEED)
        network = trained.network
        table = Table(
            title=f"{network.window} inputs x {network.spacing}, hidden: {', '.join(network.kinds) or 'none'}"
        )
        for column in ("person", "trained on", "files tested", "less rms error (%)", "linear (%)"):
            table.add_column(column, justify="left" if column == "person" else "right")
        rows: list[dict[str, object]] = []
        for person in people:
            inside = person in learning
            files = person.errors[1 if inside else 0 :]
            if not files:
                continue
            ours, linear = (mean_percent([score(n, e, wanted) for e in files]) for n in (network, trained.linear))
            rows.append({"person": person.name, "trained_on": inside, "percent": ours, "linear_percent": linear})
            table.add_row(person.name, "yes" if inside else "no", str(len(files)), f"{ours:.1f}", f"{linear:.1f}")
        write_text_atomic(out, network_text(network))
        if json_file != "-":
            data_console().print(table)
        console().print(f"weights: {out}")
        write_json(
            {
                "format": 1,
                "weights": str(out),
                "window": network.window,
                "spacing": network.spacing,
                "hidden": list(network.kinds),
                "validation_error": list(trained.validation_error),
                "training_error": list(trained.training_error),
                "candidates_tried": trained.candidates_tried,
                "rows": rows,
            },
            json_file,
        )


def _test(weights: Path, people: list[Subject], wanted: Array, json_file: str | None) -> None:
    """Print how much of the error the network of ``weights`` takes from each person's files."""
    from tools.research.tremor.cascade_file import load_network
    from tools.research.tremor.cascade_study import mean_percent, score

    network = load_network(weights)
    table = Table("person", "files tested", "less rms error (%)", title=network.note)
    rows: list[dict[str, object]] = []
    for person in people:
        percent = mean_percent([score(network, e, wanted) for e in person.errors])
        rows.append({"person": person.name, "files": len(person.errors), "percent": percent})
        table.add_row(person.name, str(len(person.errors)), f"{percent:.1f}")
    if json_file != "-":
        data_console().print(table)
    write_json({"format": 1, "weights": str(weights), "rows": rows}, json_file)
