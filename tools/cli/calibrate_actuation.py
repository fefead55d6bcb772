"""Implements ``micron calibrate piezo`` and ``manipulator``: the actuation stage's calibration files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tools.cli.common import JsonOption, clear_errors, console, data_console
from tools.errors import InputError
from tools.output import check_writable, write_calibration, write_json
from tools.terminal import table_of

if TYPE_CHECKING:
    from tools.calibrate.piezo_feedforward import Feedforward
    from tools.calibrate.piezo_fit import PiezoFit
    from tools.calibrate.piezo_prediction import Prediction

Out = Annotated[Path, typer.Option("--out", metavar="FILE", help="Calibration file (TOML) that a bench can name.")]


def recordings_of(path: Path) -> list[Path]:
    """Return the recordings of one stack: ``path`` itself, or the recordings in the folder ``path``."""
    if path.is_dir() and not (path / "recording.toml").is_file():
        recordings = sorted(child for child in path.iterdir() if (child / "recording.toml").is_file())
        if not recordings:
            raise InputError(f"{path}: neither a recording (recording.toml) nor a folder of recordings")
        return recordings
    return [path]


def piezo(
    recordings: Annotated[
        list[Path],
        typer.Argument(
            metavar="RECORDING...",
            help="One stack, or three in the order 1, 2, 3: each a recording or a folder of them.",
        ),
    ],
    out: Out,
    together: Annotated[bool, typer.Option("--together", help="All recordings are of one and the same stack.")] = False,
    json_file: JsonOption = None,
) -> None:
    """Fit a hysteresis model of each stack to drive and displacement, and check it on recordings that no fit saw.

    Example: micron calibrate piezo out/stack0 out/stack1 out/stack2 --out out/piezo.toml
    """
    from dataclasses import asdict

    from rich.progress import track

    from tools.calibrate.piezo import feedforward_of, identify_stack, piezo_calibration
    from tools.calibrate.piezo_prediction import predict
    from tools.mismatch.recording_load import load

    with clear_errors():
        check_writable(json_file, out, reads=recordings)
        groups = [recordings_of(path) for path in recordings]
        if together:
            groups = [[path for group in groups for path in group]]
        if len(groups) not in (1, 3):
            raise InputError(
                f"{len(groups)} recordings or folders: give one stack (for all three) or three (1, 2, 3), "
                "or --together when all are of one stack"
            )
        loaded = [[load(path) for path in group] for group in groups]
        named = list(zip((path.name for path in recordings), loaded, strict=False))
        fits = [
            identify_stack(group) for _, group in track(named, description="fit", console=console(), transient=True)
        ]
        predictions = [predict(fit) for fit in fits]
        inverse = feedforward_of(fits)
        write_calibration(out, piezo_calibration(fits, "piezo stacks"))
        _show(fits, predictions, inverse)
        console().print(f"written: {out}")
        write_json(
            {
                "format": 1,
                "out": str(out),
                "stacks": [_json(f, p) for f, p in zip(fits, predictions, strict=True)],
                "feedforward": asdict(inverse),
            },
            json_file,
        )


def _json(fit: PiezoFit, prediction: Prediction) -> dict[str, object]:
    from dataclasses import asdict

    plain = {**asdict(fit), "stack": fit.stack.model_dump(), "singular_um_s": fit.singular_um_s}
    del plain["others"]
    return {**plain, "prediction": asdict(prediction)}


def _show(fits: list[PiezoFit], predictions: list[Prediction], inverse: Feedforward) -> None:
    import numpy as np

    stacks = (f"stack {i + 1}" for i in range(len(fits)))
    table = table_of("Piezo stacks; errors on recordings that the fit had not seen", "", *stacks)
    row = table.add_row
    row("displacement (um)", *(f"{f.range_um:.2f}" for f in fits))
    row("best line, rms (um)", *(f"{f.linear_rms_um:.3f}" for f in fits))
    row("model, rms (um)", *(f"{f.held_out_rms_um:.3f}" for f in fits))
    row("model, largest (um)", *(f"{f.held_out_max_um:.3f}" for f in fits))
    row("plays, dead zones", *(f"{len(f.stack.play_thresholds_V)}, {len(f.stack.dead_zone_weights) - 1}" for f in fits))
    row("slopes by rate", *("yes" if f.stack.slope_per_rate_s_per_V else "no" for f in fits))
    row("creep, sum of shares (%)", *(f"{100 * sum(f.stack.creep_shares):.1f}" for f in fits))
    row("lag (ms)", *(f"{1e3 * f.lag_s:.2f}" for f in fits))
    mechanisms = [f.answer.mechanism for f in fits]
    row(
        "resonance (Hz), damping",
        *(f"{d.resonance_hz:.0f}, {d.damping:.3f}" if d.resonance_hz else "not found" for d in mechanisms),
    )
    row(
        "error at 1 to 40 Hz by lag (%)",
        *(f"{100 * a:.2f} -> {100 * b:.2f}" for a, b in zip(inverse.without, inverse.left, strict=True)),
    )
    row("fastest motion seen (um/s)", *(f"{f.top_rate_um_s:.0f}" for f in fits))
    singular = [f.singular_um_s for f in fits]
    row("singular rate (um/s)", *(f"{v:.0f}" if np.isfinite(v) else "none" for v in singular))
    row("  12.5 um p-p sine (Hz)", *(f"{v / (np.pi * 12.5):.1f}" if np.isfinite(v) else "-" for v in singular))
    row("predicted for a tremor:", *("" for _ in fits))
    row("  p-p (um)", *(f"{p.wanted_um:.1f}" for p in predictions))
    row("  rms error (um, % of p-p)", *(f"{p.rms_um:.3f}, {100 * p.rms_um / p.wanted_um:.2f}" for p in predictions))
    row("  largest (um, % of p-p)", *(f"{p.max_um:.3f}, {100 * p.max_um / p.wanted_um:.2f}" for p in predictions))
    data_console().print(table)
    data_console().print(
        f"preview: {1e3 * inverse.preview_s:.2f} ms from demand to stroke (error by lag: with it alone -> with the "
        "taps). The tremor stage's loop_delay_s is this and the time from sample to command.",
        soft_wrap=True,
    )
    for i, fit in enumerate(fits):
        for warning in fit.warnings:
            data_console().print(f"stack {i + 1}, missing: {warning}", soft_wrap=True)
        if not fit.answer.mechanism.resonance_hz:
            data_console().print(
                f"stack {i + 1}, no resonance was found: steps of a few volts, read fast enough, show it ring",
                soft_wrap=True,
            )
        if not fit.warnings:
            data_console().print(f"stack {i + 1}: nothing is missing in the excitation")
        for name, left, kept in fit.parts:
            console().print(f"stack {i + 1}: {name}: {left:.4f} um{'' if kept else ' (not kept)'}", style="dim")


def manipulator(
    recording: Annotated[Path, typer.Argument(metavar="SCAN", help="Folder or .npz of a workspace scan.")],
    out: Out,
    json_file: JsonOption = None,
) -> None:
    """Fit circle, shaft, levers, lean at rest and mounting of the manipulator to a scan of its workspace.

    Example: micron calibrate manipulator out/scan --out out/manipulator.toml
    """
    from dataclasses import asdict

    from tools.calibrate.manipulator import identify_manipulator, load_scan, manipulator_calibration

    with clear_errors():
        check_writable(json_file, out, reads=[recording])
        fit = identify_manipulator(load_scan(recording))
        write_calibration(out, manipulator_calibration(fit, f"manipulator from {recording.name}"))
        title = f"{fit.positions} positions, condition {fit.condition:.0f}"
        table = table_of(title, "parameter", "value", "95 % interval")
        for name, e in fit.parameters.items():
            table.add_row(name, f"{e.value:.4f}", f"{e.low:.4f} .. {e.high:.4f}")
        data_console().print(table)
        before, after = (", ".join(f"{v:.2f}" for v in e) for e in (fit.before_um, fit.residual_um))
        data_console().print(f"tip error rms x, y, z (um): {before} as drawn, {after} as fitted")
        for warning in fit.warnings:
            data_console().print(f"missing: {warning}", soft_wrap=True)
        console().print(f"written: {out}")
        write_json({"format": 1, "out": str(out), **asdict(fit)}, json_file)
