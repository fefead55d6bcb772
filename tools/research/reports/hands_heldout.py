"""The closed loop in every recorded hand of a folder that no setting has seen: ``micron hands --heldout FOLDER``.

Settings are those of the bench. Recordings that ``hands_development.toml`` names are left out, by their SHA-256 sums.
"""

from __future__ import annotations

import csv
import hashlib
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hal.bench import BenchFile
from hal.npz import open_npz
from sim_devices.config import emulation_config
from sim_devices.plant.hand_file import HandFileError, NoHandError, load_hand
from sim_devices.plant.recorded_hand import RecordedHand
from tools.errors import InputError
from tools.reports.figures import FOUR_BANDS_HZ, TREMOR_BAND_HZ
from tools.research.reports.hands import (
    GOAL_PERCENT,
    SETTLE_S,
    HandRow,
    above_lines,
    core_lines,
    escaped,
    explain_miss,
    run_hand,
    spectrum_lines,
)

LONGEST_S = 60.0
"""Of a longer recording the middle is taken, so that beginnings and ends (putting a sensor on) do not count."""
FITS_PERCENT = 90.0
"""A tremor fits the stroke if the stroke alone, the tremor known beforehand, would take at least this much away."""
SUFFIXES = (".npz", ".csv", ".toml")


@dataclass(frozen=True)
class Source:
    """Describes a recording: ``address`` as ``load_hand`` takes it, its name in the table, its length."""

    name: str
    address: str
    seconds: float


@dataclass(frozen=True)
class Folder:
    """Recordings of a folder in the order of their names.

    Left out: ``development``, files that settings were chosen on; ``no_hands``, files without a column of motion.
    """

    path: Path
    sources: tuple[Source, ...]
    development: tuple[str, ...]
    no_hands: tuple[str, ...] = ()


def development_sums() -> dict[str, str]:
    """Return SHA-256 sum -> file name of every recording that settings were chosen on."""
    table = tomllib.loads(Path(__file__).with_name("hands_development.toml").read_text(encoding="utf-8"))
    return {entry["sha256"]: entry["file"] for entry in table["recording"]}


def find_recordings(folder: Path, bench: BenchFile) -> Folder:
    """Return every recording of ``folder`` and of the folders in it. Each is read once, before anything runs.

    Raises ``InputError`` naming the folder, or the first recording that cannot be used.
    """
    if not folder.is_dir():
        raise InputError(
            f"{folder}: no such folder; --heldout takes a folder of recorded hands (docs/hand-recordings.md)"
        )
    seen, sources = development_sums(), list[Source]()
    left_out, no_hands = list[str](), list[str]()
    hand = emulation_config(bench.description.model_dump())
    for file in _files(folder):
        name = str(file.relative_to(folder))
        if _sum(_data_of(file)) in seen:
            left_out.append(name)
            continue
        for part in _names(file):
            address = f"{file}#{part}" if part else str(file)
            try:
                recording = load_hand(address)
                seconds = recording.seconds
                if seconds > LONGEST_S:
                    start = np.floor(0.5 * (seconds - LONGEST_S))
                    address += f"#{start:g}:{start + LONGEST_S:g}"
                RecordedHand(hand.hand, hand.seed, load_hand(address))
            except NoHandError:
                no_hands.append(name)
                break
            except HandFileError as error:
                raise InputError(f"{error} (docs/hand-recordings.md; move it elsewhere to leave it out)") from error
            sources.append(Source(f"{name}#{part}" if part else name, address, seconds))
    if not sources:
        what = f"only recordings that settings were chosen on ({', '.join(left_out)})" if left_out else "no recording"
        what += f" (no motion in {', '.join(no_hands)})" if no_hands else ""
        raise InputError(f"{folder} holds {what}: put .npz, .csv or .toml recordings of hands there")
    return Folder(folder, tuple(sources), tuple(left_out), tuple(no_hands))


def _files(folder: Path) -> list[Path]:
    """Recordings below ``folder``: data files of a .toml recording are not recordings of their own."""
    files = sorted(p for p in folder.rglob("*") if p.suffix in SUFFIXES and p.is_file())
    tables = [p for p in files if p.suffix == ".toml" and p.name != "meta.toml"]
    data = {_data_of(p) for p in tables} - set(tables)
    return [p for p in files if p.name not in ("meta.toml", "index.csv") and p not in data]


def _data_of(file: Path) -> Path:
    """The file that holds the numbers of a recording."""
    if file.suffix != ".toml":
        return file
    try:
        data = tomllib.loads(file.read_text(encoding="utf-8")).get("data")
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError):
        return file
    return file.parent / data if isinstance(data, str) else file


def _sum(file: Path) -> str:
    try:
        with file.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError:
        return ""


def _names(file: Path) -> list[str]:
    """Names of the recordings in one .npz file; one empty name for a file that is one recording."""
    if file.suffix != ".npz":
        return [""]
    try:
        with open_npz(file) as data:
            if "recording_id" not in data.files:
                return [""]
            ids = [str(i) for i in np.unique(data["recording_id"])]
    except (OSError, ValueError):
        return [""]  # load_hand says what is wrong with it
    index = file.parent / "index.csv"
    if index.exists():
        with index.open(newline="") as text:
            known = {row["recording_id"]: row["name"] for row in csv.DictReader(text)}
        ids = [known.get(i, i) for i in ids]
    return ids


def run_heldout(bench: BenchFile, folder: Folder, seconds: float, progress: Callable[[str], None]) -> Iterator[HandRow]:
    """Every recording with the bench's own estimator."""
    for source in folder.sources:
        progress(source.name)
        row = run_hand(bench, source.name, source.address, seconds, progress, recorded_s=min(source.seconds, LONGEST_S))
        if row is not None:
            yield row


def stroke_percent(row: HandRow) -> float:
    """Return the share of the tremor that the stroke alone could remove with the tremor known beforehand."""
    return 100.0 * (1.0 - row.stroke_limit_um / row.figures.vector.uncompensated_rms_um)


def heldout_page(
    folder: Folder, rows: Sequence[HandRow], seconds: float, revision: str, out: Path | None = None
) -> str:
    """The page of ``micron hands --heldout``, which goes to ``out``."""
    fits = [row for row in rows if stroke_percent(row) >= FITS_PERCENT]
    reached = [row for row in fits if row.figures.vector.reduction_percent >= GOAL_PERCENT]
    missed = [row for row in fits if row not in reached]
    others = [row for row in rows if row not in fits]
    method = rows[0].method if rows else "-"
    command = f"micron hands --heldout {folder.path.name}" + ("" if out is None else f" --out {out}")
    lines = [
        "# The closed loop in hands that no setting has seen",
        "",
        f"Made by `{command}`, firmware revision {revision}; {seconds:g} s of virtual",
        f"time each, scored from {SETTLE_S:g} s after arming, estimator `{method}` with the bench's settings. Settings",
        "were chosen on the recordings of tools/research/reports/hands_development.toml; none of those is here.",
        "Tremor: rms of the tip as a vector in 8-12 Hz on the physical truth, manipulator resting (without) and",
        "working (with). Each",
        f"hand is scaled to 50 um p-p there over its middle {LONGEST_S:g} s (all of it, where it is shorter).",
        "",
        "| hand | recorded (s) | without (um rms) | with (um rms) | less (%) | the stroke alone (%) | causal (%) "
        "| fits the stroke | below 2 Hz, without -> with (um rms) | 2-8 Hz | 20-500 Hz |",
        "|---|---:|---:|---:|---:|---:|---:|---|---|---|---|",
    ]
    for row in rows:
        vector = row.figures.vector
        causal = 100.0 * (1.0 - row.causal_limit_um / vector.uncompensated_rms_um)
        others_Hz = (band for band in FOUR_BANDS_HZ if band != TREMOR_BAND_HZ)
        cells = (
            escaped(row.hand),
            f"{row.recorded_s:.0f}",
            f"{vector.uncompensated_rms_um:.2f}",
            f"{vector.compensated_rms_um:.2f}",
            f"{vector.reduction_percent:.1f}",
            f"{stroke_percent(row):.1f}",
            f"{causal:.1f}",
            "yes" if row in fits else "no",
            *(
                f"{figures.uncompensated_rms_um:.1f} -> {figures.compensated_rms_um:.1f}"
                for figures in (row.figures.bands[band] for band in others_Hz)
            ),
        )
        lines.append(f"| {' | '.join(cells)} |")
    lines += [
        "",
        f"Goal: {GOAL_PERCENT:g} % less in every hand whose tremor fits the stroke (known beforehand, the stroke alone "
        f"would take {FITS_PERCENT:g} % or more): reached in {len(reached)} of {len(fits)}.",
        "",
        "The stroke alone: what the strokes would take away if the tremor were known beforehand. Causal: what the best",
        "causal linear filter, fitted to this very hand and with sensor noise, would take away if no stroke ended.",
        "Other bands: error against the intended path.",
        "",
        *core_lines(rows),
        *above_lines(rows),
        *spectrum_lines(rows),
    ]
    if folder.development:
        lines += [f"Left out, because settings were chosen on them: {', '.join(folder.development)}.", ""]
    if folder.no_hands:
        lines += [f"Left out, because no column is a motion: {', '.join(folder.no_hands)}.", ""]
    for row in missed:
        lines += [*explain_miss(row), ""]
    for row in others:
        vector = row.figures.vector
        lines += [
            f"{row.hand}: its tremor does not fit. The stroke alone would leave {row.stroke_limit_um:.1f} of "
            f"{vector.uncompensated_rms_um:.1f} um ({100.0 - stroke_percent(row):.0f} %); the loop leaves "
            f"{vector.compensated_rms_um:.1f} um.",
            "",
        ]
    return "\n".join(lines)
