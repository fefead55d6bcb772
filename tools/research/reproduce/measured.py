"""``micron reproduce measured``: the mismatch engine on measured recordings, each scored once on a sealed test.

The engine sees the fit part alone: it splits that by itself, decides, and the corrected twin is written as a twin file.
Only then is the file run over the official test, once, beside the twin as given and the twin re-fitted without physics.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from firmware_py.recording.revision import git_revision
from hal.arrays import Array
from tools.errors import InputError
from tools.mismatch.infer import diagnose
from tools.numbers import rms
from tools.output import make_folder_of, write_text_atomic
from tools.research.prove.disk import toml_text
from tools.research.prove.runner import as_plain
from tools.research.reproduce.measured_page import document
from tools.research.reproduce.measured_rows import Scored, rows_of
from tools.research.reproduce.measured_sets import SETS, MeasuredSet
from tools.research.reproduce.recordings import data_folder
from tools.research.reproduce.rows import Table
from tools.research.results.artefact import read_page

LEAST_WINDOW = 20  # samples that the engine takes to set a state, where any may
MOST_LEFT = 20_000  # samples of a residual that are tested for what they follow


def check() -> None:
    """InputError where the recordings are not beside the project."""
    data = data_folder()
    if not (data / "emps").is_dir():
        raise InputError(
            f"{data}: the measured recordings are not here (no part of the repository); MICRON_DATA names their folder"
        )


def chosen(only: Sequence[str]) -> list[MeasuredSet]:
    """The sets with one of these names in theirs, all for none; InputError for a name that no set has."""
    unknown = [o for o in only if not any(o in s.name for s in SETS)]
    if unknown:
        raise InputError(f"no set's name has '{unknown[0]}' in it; there are {', '.join(s.name for s in SETS)}")
    return [s for s in SETS if not only or any(o in s.name for o in only)]


def _finished(path: Path) -> dict[str, Scored]:
    """Return the finished sets in the file. Raises InputError for a folder, and for a file of another kind."""
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: no JSON of finished sets ({error}); name a new file, or one of an earlier run"
        ) from error
    try:
        return {name: _scored(name, kept) for name, kept in found.items()}
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: no finished sets in it; name a new file, or one of an earlier run") from error


def table(only: Sequence[str] = (), rows_file: Path | None = None, before: Path | None = None) -> Table:
    """Run the sets and compare. ``rows_file`` (JSON) keeps each that is done; what it holds is not run again.
    ``before``: a result of an earlier run, whose rows stand for the other sets.
    """
    begin = time.perf_counter()
    wanted = chosen(only)
    found = _finished(rows_file) if rows_file is not None and rows_file.exists() else {}
    check()
    diagnosed: dict[str, tuple[dict[str, Any], float]] = {}
    for s in wanted:
        if s.name in found:
            continue
        with tempfile.TemporaryDirectory(prefix="micron-measured-") as tmp:
            found[s.name] = score(s, Path(tmp), diagnosed)
        done = found[s.name]
        print(f"{s.name}: {done.verdict} {', '.join(done.named)} ({done.cpu_s:.0f} s of CPU)", file=sys.stderr)
        if rows_file is not None:
            make_folder_of(rows_file)
            write_text_atomic(rows_file, json.dumps({n: asdict(k) for n, k in found.items()}, default=float))
    selected = [found[s.name] for s in SETS if s.name in found and (not only or s in wanted)]
    rows = tuple(row for done in selected for row in rows_of(done))
    return Table(
        "measured", rows, time.perf_counter() - begin, page=document(selected, read_page(before) if before else "")
    )


def _scored(name: str, kept: Mapping[str, Any]) -> Scored:
    left = tuple((str(a), str(b), float(c)) for a, b, c in kept["left"])
    return Scored(**{**kept, "name": name, "left": left})


def score(s: MeasuredSet, folder: Path, diagnosed: dict[str, tuple[dict[str, Any], float]]) -> Scored:
    """Diagnose the fit part of a set and score the sealed test. ``diagnosed``: reports that sets of one fit share."""
    from tools.mismatch.recording_load import load

    revision = git_revision() or "unknown"
    fit = write_part(s, folder / "fit", *s.fit)
    key = f"{s.fit}"
    try:
        if key not in diagnosed:
            cpu = time.process_time()
            report = as_plain(diagnose(load(fit)))
            diagnosed[key] = (report, time.process_time() - cpu)
        report, cpu_s = diagnosed[key]
        floors = report["fit"]["noise_floor_rms"]
        floor = _together([floors[o] for o in ([s.output] if s.output else floors)]) * s.factor
        if s.test is None:
            figures = [report["fit"][k][s.output] * s.factor for k in ("base_rms", "recalibrated_rms", "fitted_rms")]
            left = tuple(
                (d["signal"], d["feature"], float(d["strength"])) for d in report["location"]["depends_on"][:3]
            )
        else:
            figures, left = sealed(s, fit, report, folder)
    except Exception as error:  # a failure of the engine is a result, not ours to raise
        return Scored(s.name, {}, None, None, None, None, (), 0.0, revision, f"{type(error).__name__}: {error}")
    small = {k: report[k] for k in ("verdict", "summary", "location", "equivalent")}
    small["physics"] = [
        {k: p[k] for k in ("name", "output", "stage", "confidence", "parameters")} for p in report["physics"]
    ]
    return Scored(s.name, small, figures[0], figures[1], figures[2], floor, left, cpu_s, revision)


def write_part(s: MeasuredSet, folder: Path, descriptor: str, span: tuple[int, int] | None, repeat: int = 1) -> Path:
    """A recording of a sample range of one file, without a split, ``repeat`` times in a row."""
    head = tomllib.loads((data_folder() / descriptor).read_text())
    with np.load((data_folder() / descriptor).parent / head["data"]) as file:
        columns = {c["column"]: file[c["column"]].astype(float) for c in head["channels"]}
    a, b = span or (0, len(next(iter(columns.values()))))
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(folder / "data.npz", **{k: np.tile(x[a:b], repeat) for k, x in columns.items()})  # pyright: ignore[reportArgumentType]
    head = {k: v for k, v in head.items() if k != "split"} | {"data": "data.npz"}
    if s.twin is not None:
        head["twin"] = dict(s.twin)
    (folder / "recording.toml").write_text(toml_text(head))
    return folder / "recording.toml"


def sealed(
    s: MeasuredSet, fit: Path, report: Mapping[str, Any], folder: Path
) -> tuple[list[float], tuple[tuple[str, str, float], ...]]:
    """Residual rms on the sealed test, (as given, re-fitted, corrected), and what the last one follows."""
    from tools.mismatch.apply import corrected_twin
    from tools.mismatch.engine.pose import opened
    from tools.mismatch.export.run import free_run
    from tools.mismatch.recording import TwinText
    from tools.mismatch.recording_load import load
    from tools.mismatch.twins.make import make

    assert s.test is not None
    descriptor, span = s.test
    same_file = descriptor == s.fit[0]
    # a test on the same record is reached by running through it: its inputs are known
    path = write_part(s, folder / "test", descriptor, None if same_file else span, s.periods)
    test = load(path)
    first = load(fit)
    twin = make(first)
    shifts = report["fit"]["base_parameters"]
    if [b["name"] for b in shifts] != [p.name for p in twin.parameters]:
        # the engine wrote the twin in another way: as two filters
        twin = make(opened(first))
    alone = np.array([b["alone"] for b in shifts])
    base = dict(twin.to_text(alone))
    table = tomllib.loads(corrected_twin(fit, report).text)["twin"]
    texts = (
        test.twin,
        TwinText(first.twin.kind, base),
        TwinText(table["kind"], table["parameters"], tuple(table.get("effects", ()))),
    )
    init = s.initialization
    if not same_file:
        dynamic = hasattr(twin, "fastest_per_s")
        init = max(init, LEAST_WINDOW) if init and dynamic else init
        test = replace(test, split=replace(test.split, initialization=init or None))
    a, b = span if same_file and span is not None else (0, test.n)
    if s.periods > 1:
        a = test.n - test.n // s.periods
    rows = slice(a + init, b)
    outputs = [s.output] if s.output else list(test.outputs)
    figures: list[float] = []
    away: dict[str, Array] = {}
    simulated: dict[str, Array] = {}
    for text in texts:
        simulated = free_run(replace(test, twin=text))
        away = {o: test.outputs[o] - simulated[o] for o in outputs}
        if s.mean_free:
            away = {o: r - np.mean(r[rows]) for o, r in away.items()}
        figures.append(s.factor * _together([rms(away[o][rows]) for o in outputs]))
    worst = max(outputs, key=lambda o: rms(away[o][rows]))
    signals = {name: x[rows] for name, x in test.signals.items()}
    return figures, follows(away[worst][rows], signals, worst, simulated[worst][rows], test.dt)


def follows(
    residual: Array, signals: Mapping[str, Array], output: str, motion: Array, dt: float
) -> tuple[tuple[str, str, float], ...]:
    """(signal, feature, share of variance) that a residual (n,) follows, strongest first; three at most."""
    from tools.mismatch.engine.dependence import dependences
    from tools.mismatch.engine.features import features_of

    k = max(1, -(-residual.size // MOST_LEFT))
    m = residual.size // k

    def mean(x: Array) -> Array:
        return x[: m * k].reshape(m, k).mean(axis=1)

    thin = {name: mean(x) for name, x in (*signals.items(), (output, motion))}
    drive = next(iter(signals)) if len(signals) == 1 else ""
    found = dependences(mean(residual), features_of(thin, dt * k, drive=drive, motion=output))
    real = [d for d in found if d.p_value < 1e-3 and d.strength > 0.01]
    return tuple((d.signal, d.feature, float(d.strength)) for d in real[:3])


def _together(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
