"""The tool on measured recordings with published figures: writes docs/mismatch-on-real-data.md and JSON rows."""

from __future__ import annotations

import json
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from firmware_py.recording.revision import git_revision
from tools.errors import InputError
from tools.mismatch.prove.disk import toml_text
from tools.mismatch.prove.real_sets import SETS, RealSet
from tools.mismatch.prove.runner import Diagnose, as_plain, diagnose_all

DOC = Path("docs/mismatch-on-real-data.md")
DATA = Path(__file__).resolve().parents[4] / "shared" / "data"


def _columns(descriptor: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    head = tomllib.loads(descriptor.read_text())
    with np.load(descriptor.parent / head["data"]) as file:
        return head, {c["column"]: file[c["column"]].astype(float) for c in head["channels"]}


def joined(real: RealSet, data: Path, folder: Path) -> Path:
    """One recording with the official split in it: fit part first, then the test part where it is a file of its own."""
    head, columns = _columns(data / real.fit)
    n = len(next(iter(columns.values())))
    split: dict[str, Any] | None = None
    if isinstance(real.test, str):
        _, more = _columns(data / real.test)
        columns = {k: np.concatenate([v, more[k]]) for k, v in columns.items()}
        split = {"fit": [0, n], "test": [n, len(next(iter(columns.values())))]}
    elif real.test is not None:
        given = head["split"]["fit"]
        split = {"fit": given, "test": list(real.test)}
    if split and real.initialization:
        split["initialization"] = real.initialization
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(folder / "data.npz", **columns)  # pyright: ignore[reportArgumentType]
    head = {k: v for k, v in head.items() if k != "split"} | {"data": "data.npz"}
    if split:
        head["split"] = split
    path = folder / "recording.toml"
    path.write_text(toml_text(head))
    return path


@dataclass(frozen=True)
class RealRow:
    real: RealSet
    report: dict[str, Any]
    cpu_s: float
    revision: str

    def rms(self, key: str) -> float | None:
        value = ((self.report.get("fit") or {}).get(key) or {}).get(self.real.output)
        return None if value is None else float(value) * self.real.factor

    def said(self) -> str:
        names = [str(p["name"]) for p in self.report.get("physics") or []]
        return f"{self.report['verdict']}: {', '.join(names)}" if names else str(self.report["verdict"])


def tool_aloud(path: Path) -> dict[str, Any]:
    """As ``tool``; says on standard error every few seconds how far it is."""
    from tools.mismatch.engine.diagnose import diagnose
    from tools.mismatch.recording_load import load

    began = last = time.monotonic()

    def say(what: str, done: int, total: int) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last > 5.0:
            last = now
            print(f"  {path.parent.name}: {what} {done}/{total}, {now - began:.0f} s", file=sys.stderr, flush=True)

    return as_plain(diagnose(load(path), jobs=1, seed=0, progress=say))


def run(
    data: Path = DATA,
    *,
    only: Sequence[str] = (),
    jobs: int = 1,
    diagnose: Diagnose = tool_aloud,
    say: Callable[[str], None] | None = None,
    rows_file: Path | None = None,
) -> list[RealRow]:
    """Diagnose every set on its official split. FileNotFoundError when the data are not beside the project,
    InputError when no set has a name of ``only``.

    ``rows_file`` (JSON) keeps each set as soon as it is done; what it already holds counts and is returned, so that
    the sets may be run one by one. Remove it when the tool changes; the page names the state that made each.
    """
    unknown = [o for o in only if not any(o in s.name for s in SETS)]
    if unknown:
        raise InputError(f"no set's name has '{unknown[0]}' in it; there are {', '.join(s.name for s in SETS)}")
    tell = say or (lambda text: print(text, file=sys.stderr, flush=True))
    if not data.is_dir():
        raise FileNotFoundError(f"{data}: the measured recordings are not here; they are not part of the repository")
    revision = git_revision()
    chosen = {s.name: s for s in SETS if not only or any(o in s.name for o in only)}
    kept: dict[str, Any] = json.loads(rows_file.read_text()) if rows_file is not None and rows_file.exists() else {}
    wanted = {s.name: s for s in SETS if s.name in chosen or s.name in kept}
    with tempfile.TemporaryDirectory(prefix="micron-real-") as tmp:
        paths = {
            name: joined(s, data, Path(tmp) / name.replace(" ", "_")) for name, s in chosen.items() if name not in kept
        }
        rows = {
            name: RealRow(wanted[name], k["report"], k["cpu_s"], k["revision"])
            for name, k in kept.items()
            if name in wanted
        }
        for done in diagnose_all(paths, jobs, diagnose):
            name = done.name
            rows[name] = RealRow(chosen[name], done.report, done.cpu_s, revision)
            tell(f"{name}: {rows[name].said()} ({done.wall_s:.0f} s, {done.cpu_s:.0f} s of CPU)")
            if rows_file is not None:
                kept[name] = {"report": done.report, "cpu_s": done.cpu_s, "revision": revision}
                rows_file.write_text(json.dumps(kept))
    return [rows[name] for name in wanted]


def rows_json(rows: Sequence[RealRow], seconds: float) -> dict[str, Any]:
    """`reproduce mismatch-real`, contract/commands.md."""
    out: list[dict[str, Any]] = []
    for r in rows:
        ours = r.rms("fitted_rms")
        for p in r.real.published:
            meets = ours is not None and ours <= p.figure
            out.append(
                {
                    "source": p.source,
                    "quantity": f"rms error on the official test split, {r.real.title}",
                    "unit": r.real.unit,
                    "condition": f"against: {p.what}; ours: {r.said()}",
                    "published": p.figure,
                    "ours": ours,
                    "better": "lower",
                    "kind": "recording",
                    "meets": meets,
                    "why": "" if meets else _why(r),
                }
            )
    return {"format": 1, "name": "mismatch-real", "seconds": round(seconds, 1), "rows": out}


def _why(r: RealRow) -> str:
    if r.report.get("error"):
        return str(r.report["error"])
    return str(r.report.get("summary", ""))


def _figure(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"


def document(rows: Sequence[RealRow]) -> str:
    """The text of docs/mismatch-on-real-data.md; sets that were not run are named."""
    absent = [s.name for s in SETS if s.name not in {r.real.name for r in rows}]
    date = time.strftime("%Y-%m-%d", time.gmtime())
    lines = [
        "# The mismatch tool on measured recordings",
        "",
        "Made by `python -m tools.mismatch.prove.real`; do not edit. Each set starts from the naive twin that its own "
        "papers give; fit and test parts are the official ones (the accelerometer package: held-out blocks of its "
        "test sweep, since the lag differs from run to run). Errors are rms on data that no fit has seen; "
        "which effects to name is decided on that part, too, so a figure is a little kinder than one of a third part "
        "would be. The data are not part of the repository.",
        "",
        f"{date}; each row says which state of the tool made it. The seconds are CPU time of one process, "
        "up to twice what they would be on a machine of its own.",
        "",
        *([f"Not run for this page: {', '.join(absent)}.", ""] if absent else []),
        "| set | unit | naive | re-calibrated | with physics | noise (tool's) | left over noise | published "
        "| what it said | CPU s | tool |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        published = "; ".join(f"{p.figure:g} ({p.what})" for p in r.real.published)
        cells = [_figure(r.rms(k)) for k in ("base_rms", "recalibrated_rms", "fitted_rms", "noise_floor_rms")]
        left, floor = r.rms("fitted_rms"), r.rms("noise_floor_rms")
        ratio = left / floor if left is not None and floor else None
        # a recording without broad-band noise (filtered by those who made it) has no floor to read
        cells.append("" if ratio is None else f"{ratio:.1f}" if ratio < 1000.0 else "> 1000")
        lines.append(
            f"| {r.real.name} | {r.real.unit} | {' | '.join(cells)} | {published} | {r.said()} | {r.cpu_s:.0f} "
            f"| {r.revision[:8]} |"
        )
    lines.append("")
    for r in rows:
        location = r.report.get("location") or {}
        follows = ", ".join(f"{d['signal']} ({d['feature']})" for d in (location.get("depends_on") or [])[:3])
        same = [", ".join(g["names"]) for g in r.report.get("equivalent") or []]
        names = [str(p["name"]) for p in r.report.get("physics") or []]
        agree = ""
        if r.real.found:
            hit = bool(set(names) & set(r.real.found))
            agree = "The tool names the chief of it" if hit else "The tool does not name it"
            unnamed = [n.replace("_", " ") for n in r.real.beside if n not in names]
            agree += f"; not named: {', '.join(unnamed)}." if unnamed else "."
        lines += [
            f"## {r.real.title}",
            "",
            f"What its authors know: {r.real.known} {agree}".rstrip(),
            "",
            f"What the tool said: {r.report.get('summary') or r.report.get('error', '')}",
            "",
            f"Where: outputs {', '.join(location.get('outputs') or ['-'])}; stage {location.get('stage') or '-'}; "
            f"{location.get('regime') or '-'}; follows {follows or 'nothing in particular'}.",
            "",
        ]
        if r.real.remark:
            lines += [f"Why the figure is what it is (looked at by hand): {r.real.remark}", ""]
        if same:
            lines += [f"It cannot tell apart here: {'; '.join(same)}.", ""]
    return "\n".join(lines)


def reproduce(
    data: Path = DATA,
    *,
    only: Sequence[str] = (),
    jobs: int = 1,
    doc: Path | None = DOC,
    rows_file: Path | None = None,
) -> dict[str, Any]:
    """Run all sets, write the page, return the JSON of `micron reproduce mismatch-real`."""
    start = time.perf_counter()
    rows = run(data, only=only, jobs=jobs, rows_file=rows_file)
    if doc is not None:
        doc.parent.mkdir(parents=True, exist_ok=True)
        doc.write_text(document(rows))
    return rows_json(rows, time.perf_counter() - start)


def main() -> None:
    import argparse
    import os

    for key in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(key, "1")
    p = argparse.ArgumentParser(description="the mismatch tool on measured recordings")
    p.add_argument("--data", type=Path, default=DATA)
    p.add_argument("--only", nargs="*", default=[], help="parts of set names")
    p.add_argument("--jobs", type=int, default=1)
    p.add_argument("--doc", type=Path, default=DOC)
    p.add_argument("--rows", type=Path, default=None, help="JSON kept after every set, and continued from")
    p.add_argument("--json", type=Path, default=None)
    a = p.parse_args()
    try:
        result = reproduce(a.data, only=a.only, jobs=a.jobs, doc=a.doc, rows_file=a.rows)
    except (FileNotFoundError, InputError) as error:
        p.error(str(error))
    text = json.dumps(result, indent=1)
    if a.json:
        a.json.write_text(text)
    else:
        print(text)


if __name__ == "__main__":
    main()
