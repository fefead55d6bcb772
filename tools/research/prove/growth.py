"""Time and memory of ``diagnose --together`` against the number of recordings: on this machine and on Dask.

``python -m tools.research.prove.growth --keep FOLDER --out FILE`` goes on where it stopped. The recordings are like
those of ``docs/many-recordings.md``: a stack with a play of 12 V and a gain that falls with temperature, 60 s at 200 Hz
each.
Every row is one run of the command in a process of its own. The processor time is that of the command, start and
loading included, and of the workers of the cluster; the cluster's scheduler is not in it.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from tools.errors import InputError
from tools.research.prove.harness import read_rows
from tools.research.results.artefact import write_result
from tools.research.stamp import revision_and_day

FILE = "growth.jsonl"
COUNTS = (25, 50, 100, 200)
RATE_HZ, SECONDS = 200.0, 60.0
PLACES = {"here": "this machine, joblib", "dask": "Dask"}
UNITS = {"here": "processes", "dask": "workers"}
PLAY_V, WEIGHT_UM_PER_V, GAIN_UM_PER_V, PER_K, NOISE_UM = 12.0, 0.0013, 0.12, -0.004, 0.02
"""Width of the play, its weight, gain at 20 degrees, relative change of the gain per kelvin, and rms of the noise."""
LINEAR = 1.0
"""Largest exponent of the growth that counts as linear."""
DESCRIPTOR = """format = 1
data = "data.npz"
rate_hz = {rate}

[conditions]
temperature_C = {temperature}

[twin]
kind = "piezo_stack"
parameters = {{ gain_um_per_V = 0.12, offset_um = 0.0, hold = "linear" }}

[[channels]]
column = "command_V"
role = "input"
signal = "command"
unit = "V"

[[channels]]
column = "displacement_um"
role = "output"
signal = "displacement"
unit = "um"
"""


def write_runs(folder: Path, count: int, seconds: float = SECONDS) -> None:
    """Write ``count`` recordings of the same stack, each with an input and a temperature of its own."""
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    for day in range(count):
        rng = np.random.default_rng(day)
        temperature = float(np.round(rng.uniform(18.0, 32.0), 1))
        volts = 50 + 25 * np.sin(2 * np.pi * 0.41 * t + day) + 15 * np.sin(2 * np.pi * (1.3 + 0.1 * (day % 7)) * t)
        lagging, p = np.empty(t.size), float(volts[0])
        for i, v in enumerate(volts.tolist()):
            p = max(v - PLAY_V / 2, min(v + PLAY_V / 2, p))
            lagging[i] = p
        um = GAIN_UM_PER_V * (1 + PER_K * (temperature - 20)) * volts + WEIGHT_UM_PER_V * (lagging - volts)
        um += rng.normal(0.0, NOISE_UM, t.size)
        run = folder / f"day{day:03d}"
        run.mkdir(parents=True)
        np.savez(run / "data.npz", command_V=volts, displacement_um=um)
        (run / "recording.toml").write_text(DESCRIPTOR.format(rate=RATE_HZ, temperature=temperature), encoding="utf-8")


def _usage() -> tuple[float, float]:
    """Return processor seconds and largest memory in MB of this process."""
    own = resource.getrusage(resource.RUSAGE_SELF)
    return own.ru_utime + own.ru_stime, own.ru_maxrss / 1024


@contextmanager
def cluster(workers: int) -> Iterator[tuple[str, Any]]:
    """Start a Dask cluster of ``workers`` processes with one thread each; its address and a client.

    Raises:
        InputError: Dask is not installed.
    """
    if importlib.util.find_spec("distributed") is None:
        raise InputError("--place dask needs Dask: pip install 'micron-bench[dask]'")
    from distributed import Client, LocalCluster

    options: dict[str, Any] = {"threads_per_worker": 1, "processes": True, "dashboard_address": "127.0.0.1:0"}
    local: Any = LocalCluster(n_workers=workers, host="127.0.0.1", silence_logs=50, **options)
    with local, Client(local, set_as_default=False) as client:
        yield local.scheduler_address, client


def diagnosed(runs: Path, options: Sequence[str]) -> dict[str, Any]:
    """Run the command on all recordings below ``runs``; what it cost and what it named.

    Raises:
        InputError: the command failed.
    """
    out = runs.parent / "together.json"
    command = [sys.executable, "-m", "tools.cli.main", "mismatch", "diagnose", str(runs), "--together"]
    began = time.monotonic()
    with (runs.parent / "log").open("w+", encoding="utf-8") as log:
        child = subprocess.Popen(
            [*command, "--per-recording", "gain", "--json", str(out), *options], stdout=log, stderr=log
        )
        _, status, used = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        if child.returncode != 0:
            log.seek(0)
            raise InputError(f"diagnose ended with {child.returncode}: {log.read()[-500:]}")
    report = json.loads(out.read_text(encoding="utf-8"))
    return {
        "cpu_s": round(used.ru_utime + used.ru_stime, 1),
        "wall_s": round(time.monotonic() - began, 1),
        "peak_MB": round(used.ru_maxrss / 1024),
        "names": [p["name"] for p in report["physics"]],
        "changes": [f"{c['parameter']}: {c['condition']}" for c in report["together"]["changes"]],
    }


def run_one(count: int, place: str, processes: int, seconds: float = SECONDS) -> dict[str, Any]:
    """Diagnose ``count`` recordings at one of ``PLACES``; the outcome as a row."""
    row: dict[str, Any] = {"recordings": count, "place": place, "processes": processes, "revision": revision_and_day()}
    row |= {"seconds": seconds, "samples": count * round(seconds * RATE_HZ)}
    with tempfile.TemporaryDirectory(prefix="micron-growth-") as folder:
        runs = Path(folder) / "runs"
        write_runs(runs, count, seconds)
        if place == "here":
            return row | diagnosed(runs, ["--jobs", str(processes)])
        with cluster(processes) as (address, client):
            before = client.run(_usage)
            row |= diagnosed(runs, ["--dask", address])
            after = client.run(_usage)
    if before.keys() != after.keys():
        raise InputError("a worker of the cluster was lost, so its processor time is not known")
    row["cpu_s"] = round(row["cpu_s"] + sum(after[w][0] - before[w][0] for w in after), 1)
    row["workers_MB"] = round(max(mb for _, mb in after.values()))
    return row


def exponent(rows: Sequence[dict[str, Any]], key: str) -> float:
    """Return the slope of the logarithm of ``key`` against that of the number of recordings, by least squares."""
    n = np.log([float(r["recordings"]) for r in rows])
    return float(np.polyfit(n, np.log([float(r[key]) for r in rows]), 1)[0])


def not_run(rows: Sequence[dict[str, Any]], counts: Sequence[int], places: Sequence[str]) -> str:
    """Return the numbers of recordings of each place that are not in ``rows``, in words; "none" if all are."""
    done = {(r["place"], r["recordings"]) for r in rows}
    left = {p: [str(n) for n in sorted(counts) if (p, n) not in done] for p in places}
    return "; ".join(f"{PLACES[p]}: {', '.join(n)}" for p, n in left.items() if n) or "none"


def page(rows: Sequence[dict[str, Any]], counts: Sequence[int] = COUNTS, places: Sequence[str] = tuple(PLACES)) -> str:
    """Return the result's page; ``counts`` and ``places`` are those that were asked for."""
    rows = sorted(rows, key=lambda r: (r["place"] != "here", r["processes"], r["recordings"]))
    revisions = "; ".join(dict.fromkeys(r["revision"] for r in rows))
    kinds = dict.fromkeys((r["place"], r["processes"]) for r in rows)
    lines, slopes = list[str](), list[str]()
    for place, processes in kinds:
        some = [r for r in rows if (r["place"], r["processes"]) == (place, processes)]
        label = f"{PLACES[place]}, {UNITS[place]}: {processes}"
        for r in some:
            memory = f"{r['peak_MB']}" + (f", each worker {r['workers_MB']}" if "workers_MB" in r else "")
            answers = ", ".join((*r["names"], *r["changes"])).replace("_", " ") or "nothing"
            lines.append(
                f"| {label} | {r['recordings']} | {r['samples']} | {r['cpu_s']:.0f} | "
                f"{r['cpu_s'] / r['recordings']:.2f} | {r['wall_s']:.0f} | {memory} | {answers} |"
            )
        if len(some) > 1:
            cpu, mb = exponent(some, "cpu_s"), exponent(some, "peak_MB")
            slopes.append(
                f"- {label}: processor time grows with the power {cpu:.2f} of the number of recordings, memory of the "
                f"command with the power {mb:.2f}."
            )
    return f"""# Time and memory of many recordings

Made by `python -m tools.research.prove.growth --keep FOLDER --out docs/results/growth.json`, revision {revisions}; do
not edit.

Recordings of {rows[0]["seconds"]:g} s at {RATE_HZ:g} Hz with a play and a gain that falls with temperature, by `micron
mismatch diagnose RUNS --together --per-recording gain`. Processor time is that of the command, start and loading
included, and of the workers of the cluster. More than a million samples are searched by one process of this machine.
The goal is a power of at most {LINEAR:g} of the number of recordings.

| where | recordings | samples | processor s | per recording | wall s | largest MB | named |
|---|---|---|---|---|---|---|---|
{chr(10).join(lines)}

{chr(10).join([*slopes, f"- Not run, for lack of processor time: {not_run(rows, counts, places)}."])}
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is not done yet and print the page; exit status 2 on bad input."""
    parser = argparse.ArgumentParser(description="Measure time and memory of diagnosing recordings together.")
    parser.add_argument("--keep", type=Path, required=True, help=f"{FILE} there; a stopped run goes on")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the result there (.json or .md)")
    parser.add_argument("--counts", type=int, nargs="+", default=list(COUNTS))
    parser.add_argument("--place", choices=tuple(PLACES), nargs="+", default=list(PLACES))
    parser.add_argument("--processes", type=int, default=2, help="processes of this machine, or workers of Dask")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="begin no run after these")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="length of each recording")
    options = parser.parse_args(arguments)
    options.keep.mkdir(parents=True, exist_ok=True)
    file = options.keep / FILE
    rows = [r for r in read_rows(file) if r["seconds"] == options.seconds]
    done = {(r["recordings"], r["place"], r["processes"]) for r in rows}
    began = time.monotonic()
    try:
        for place in options.place:
            for count in sorted(options.counts):
                late = time.monotonic() - began >= 60 * options.minutes
                if late or (count, place, options.processes) in done:
                    continue
                rows.append(run_one(count, place, options.processes, options.seconds))
                with file.open("a", encoding="utf-8") as out:
                    out.write(json.dumps(rows[-1]) + "\n")
    except InputError as error:
        parser.error(str(error))
    if not rows:
        return 0
    text = page(rows, options.counts, options.place)
    print(text)
    if options.out is not None:
        write_result(options.out, text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
