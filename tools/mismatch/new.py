"""Implements ``micron mismatch new``: a data file becomes a ``recording.toml`` and a picture of the columns."""

from __future__ import annotations

import os
import tempfile
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tools.errors import InputError, RecordingError
from tools.mismatch import units
from tools.mismatch.cut import Stretch, cut_columns
from tools.mismatch.guess import Guess, guess, is_assumed_clock
from tools.mismatch.key_tables import of_kind
from tools.mismatch.new_text import recording_text
from tools.mismatch.recording import Array
from tools.mismatch.recording_columns import read_columns
from tools.mismatch.recording_load import from_table
from tools.mismatch.recording_ranges import APART
from tools.mismatch.twins.vocabulary import KINDS, user_kinds, vocabulary
from tools.output import check_writable, save_figure, write_text_atomic

CHECKED_BYTES = 64 << 20
"""Size up to which a data file is loaded before the descriptor is written; a larger one is checked by its form."""
_COLOURS = {"time": "#7f7f7f", "input": "#0072b2", "output": "#d55e00", "context": "#009e73", "": "#b0b0b0"}


@dataclass(frozen=True)
class NewRecording:
    """Describes the written files. ``data`` is the descriptor's data file; ``stretch`` what was cut or resampled."""

    path: Path
    picture: Path
    data: Path
    guess: Guess
    stretch: Stretch | None

    def to_json(self) -> dict[str, Any]:
        """Return the result as JSON values."""
        g = self.guess
        return {
            "format": 1,
            "recording": str(self.path),
            "picture": str(self.picture),
            "data": str(self.data),
            "samples": g.samples if self.stretch is None else self.stretch.samples,
            "rate_hz": g.rate_hz if self.stretch is None else self.stretch.rate_hz,
            "segments": [] if self.stretch is None else list(self.stretch.segments),
            "kind": g.kind,
            "columns": [{"name": c.name, "role": c.role, "signal": c.signal, "unit": c.unit} for c in g.columns],
            "unknown": g.unknown,
            "assumed": g.assumed,
            "notes": g.notes,
        }


MOST_FILLED = 0.1
"""Share of interpolated samples above which the user is told."""


def new_recording(
    data: Path,
    out: Path | None = None,
    kind: str = "",
    *,
    rate_hz: float | None = None,
    resample_hz: float | None = None,
    cut: bool = False,
    force: bool = False,
) -> NewRecording:
    """Guess what ``data`` holds and write the descriptor ``out`` (default: ``recording.toml`` beside it) and a picture.

    ``kind``: the twin; ``rate_hz``: the rate, in place of a column of time; ``resample_hz``: bring it to even steps at
    this rate; ``cut``: at the usual rate. Both cut at gaps, and write the columns beside the descriptor. Nothing is
    written where something is wrong. Raises InputError.
    """
    if kind and vocabulary(kind) is None:
        raise InputError(f"--twin {kind}: unknown kind; known kinds: {', '.join([*KINDS, *user_kinds()])}")
    out = data.with_name("recording.toml") if out is None else out
    rewrites = cut or resample_hz is not None
    targets = _targets(data, out, rewrites, force)
    found = guess(data, kind)
    if rate_hz is not None:
        found = _at_rate(found, rate_hz)
    found = replace(
        found, unknown=[*found.unknown, *_needed(found.kind)], assumed=[*found.assumed, *_left_out(found.kind)]
    )
    stretch, columns = None, None
    if rewrites:
        stretch, columns, found = _rewritten(data, found, resample_hz)
    elif found.broken:
        raise InputError(f"{data}: {'; '.join(found.broken)}.\n{_offer(found)}")
    named = targets[2] if rewrites else data
    text = recording_text(found, data.name, os.path.relpath(named, out.parent), stretch)
    if not found.unknown:
        _check(text, out, data, found, columns)
    _write(targets, text, found, data.name, columns)
    return NewRecording(out, targets[1], named, found, stretch)


def _at_rate(found: Guess, rate_hz: float) -> Guess:
    """Return the guess with the rate that a person stated, in place of a column of time."""
    clock = found.clock
    notes = [f"column '{clock}' is not used: the rate is given"] if clock else []
    return replace(
        found,
        rate_hz=rate_hz,
        clock="",
        time_column="",
        columns=[replace(c, role="") if c.role == "time" else c for c in found.columns],
        unknown=[text for text in found.unknown if not text.startswith("the rate: ")],
        assumed=[text for text in found.assumed if not (clock and is_assumed_clock(text, clock))],
        broken=[text for text in found.broken if not text.startswith(f"the time in '{clock}'")],
        notes=[*(n for n in found.notes if not (clock and n.startswith(f"column '{clock}' is the time"))), *notes],
    )


def _targets(data: Path, out: Path, rewrites: bool, force: bool) -> list[Path]:
    """Return descriptor, picture and, if columns are rewritten, their file; check that all can be written."""
    if out.suffix.lower() != ".toml":
        raise InputError(f"--out {out}: name a file that ends in .toml")
    if not rewrites and data.is_file() and out.resolve().parent not in data.resolve().parents:
        raise InputError(
            f"--out {out}: a recording lies in the folder of its data; copy {data.name} there, or name a file in"
            f" {data.parent}"
        )
    targets = [out, out.with_suffix(".png")]
    if rewrites:
        npz = out.with_suffix(".npz")
        targets.append(npz if npz.resolve() != data.resolve() else out.with_name(f"{out.stem}-even.npz"))
    existing = [str(p) for p in targets if p.exists()]
    if existing and not force:
        raise InputError(
            f"{', '.join(existing)}: is there already; name another file with --out, or repeat with --force"
        )
    if any(p.resolve() == data.resolve() for p in targets):
        raise InputError(f"{data}: would be overwritten; name another file with --out")
    check_writable(*targets, overwrite=True)  # what is there was agreed to with --force
    return targets


def _needed(kind: str) -> list[str]:
    """Return a message on the parameters that a kind of twin requires; empty if it requires none."""
    keys = [k.name for k in of_kind(kind) if not k.default and k.name.isidentifier()] if kind in KINDS else []
    if kind == "ode":
        return ["the twin's equations: write [twin.states], [twin.equations] and the numbers in [twin.parameters]"]
    return [f"the twin's {', '.join(keys)}: a {kind} needs them in [twin.parameters]"] if keys else []


def _left_out(kind: str) -> list[str]:
    return ["the axis has no spring; if it has one, give its stiffness"] if kind == "mechanical_axis" else []


def _offer(found: Guess) -> str:
    rate = f"{found.rate_hz:.6g}" if found.rate_hz else "RATE"
    return (
        "Repeat with --cut: the columns are brought to even steps, cut at gaps into runs that are diagnosed together;"
        f" or with --resample {rate}, or another rate."
    )


def _rewritten(data: Path, found: Guess, resample_hz: float | None) -> tuple[Stretch, dict[str, Array], Guess]:
    """Return the used columns on a uniform clock, cut at gaps."""
    used = [c.name for c in found.columns if c.role in ("input", "output", "context")]
    read = read_columns(data, list(dict.fromkeys([*used, *([found.clock] if found.clock else [])])))
    if found.clock:
        t = units.convert(read[found.clock], found.clock_unit, "s")
    elif found.rate_hz is not None:
        t = np.arange(found.samples) / found.rate_hz
    else:
        raise InputError(f"{data}: no column is a time; give the rate of the file with --rate HZ")
    every = not found.kind or found.kind in APART
    columns, stretch = cut_columns(data, t, {k: read[k] for k in used}, every=every, rate_hz=resample_hz)
    notes = [*found.notes, *found.broken]
    if resample_hz is None and stretch.filled > MOST_FILLED * stretch.samples:
        mean_hz = t.size * stretch.rate_hz / stretch.samples
        notes.append(
            f"{stretch.filled} of {stretch.samples} samples lie where nothing was measured, on straight lines: noise"
            f" and fast motion are misread there; --resample {0.5 * mean_hz:.3g} takes means instead"
        )
    if stretch.kept < stretch.parts:
        why = "shorter ones are dropped" if every else f"a {found.kind} runs through: the longest is kept"
        notes.append(f"{stretch.parts} stretches without gaps, {stretch.kept} kept: {why}")
    return stretch, columns, replace(found, notes=notes, broken=[], time_column="")


def _check(text: str, out: Path, data: Path, found: Guess, columns: dict[str, Array] | None) -> None:
    """Load the descriptor as ``diagnose`` will. Raises InputError with the loader's message."""
    if columns is None and data.stat().st_size > CHECKED_BYTES:
        columns = _stand_in(found)
    try:
        from_table(out, tomllib.loads(text), columns)
    except RecordingError as error:
        raise InputError(str(error).replace(str(data.resolve()), str(data))) from None


def _stand_in(found: Guess) -> dict[str, Array]:
    """Return synthetic columns with the names and the time step of a large file."""
    n = 1000
    return {
        c.name: np.arange(n) / (found.rate_hz or 1.0)
        if c.name == found.time_column
        else np.sin((k + 1.0) * np.arange(n))
        for k, c in enumerate(found.columns)
    }


def _write(targets: Sequence[Path], text: str, found: Guess, title: str, columns: dict[str, Array] | None) -> None:
    """Write the columns, the picture, and last the descriptor; on failure remove the files written so far."""
    before = [p.exists() for p in targets]
    try:
        if columns is not None:
            _save(targets[2], columns)
        _draw(found, title, targets[1])
        write_text_atomic(targets[0], text)
    except BaseException:
        for path, was in zip(targets, before, strict=True):
            if not was:
                path.unlink(missing_ok=True)
        raise


def _save(path: Path, columns: dict[str, Array]) -> None:
    handle, name = tempfile.mkstemp(dir=path.resolve().parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez(file, **columns)  # pyright: ignore[reportArgumentType]
        os.chmod(name, 0o644)
        os.replace(name, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error}); free some space") from error
    finally:
        Path(name).unlink(missing_ok=True)


def _draw(found: Guess, title: str, path: Path) -> None:
    """Draw a strip per column: the smallest and largest value of each part of the file."""
    from matplotlib.figure import Figure

    drawn = [c for c in found.columns if c.name != found.clock] or found.columns
    figure = Figure(figsize=(9.0, 1.0 + 1.2 * len(drawn)), dpi=100, layout="constrained")
    axes = figure.subplots(len(drawn), 1, squeeze=False, sharex=True)[:, 0]
    for ax, column in zip(axes, drawn, strict=True):
        x = (np.arange(len(column.low)) + 0.5) / len(column.low) * found.samples
        low, high = np.array(column.low), np.array(column.high)
        ax.fill_between(x, low, high, color=_COLOURS[column.role], alpha=0.35, lw=0)
        ax.plot(x, 0.5 * (low + high), color=_COLOURS[column.role], lw=0.9)
        ax.set_ylabel(column.unit or "?", fontsize="small")
        name = column.name.replace("$", r"\$")
        ax.set_title(f"{name}: {column.role or 'not used'}", fontsize="small", loc="left")
        ax.margins(x=0)
    axes[-1].set_xlabel("sample")
    figure.suptitle(title.replace("$", r"\$"), fontsize="medium")
    save_figure(figure, path)
