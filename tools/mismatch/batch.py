"""Diagnoses a folder of recordings in parallel: on this machine (joblib) or on a Dask cluster.

Each process diagnoses one recording with one thread: the work consists of many small matrices, on which several threads
of a linear algebra library only compete for the same core. The pieces of one long diagnosis go to a cluster by the
same joblib (``on_cluster``).
"""

from __future__ import annotations

import importlib.util
import shlex
import tomllib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from hal.errors import BenchError
from hal.trust import NotTrusted
from tools.errors import InputError
from tools.mismatch.report.wording import number, scaled, words

if TYPE_CHECKING:
    from distributed import Client

    from tools.mismatch.engine.report import Report

RETRIES = 5
"""Number of retries of a recording whose Dask worker is lost."""


@dataclass(frozen=True)
class Job:
    """Names a recording to diagnose; ``out`` is its own folder for report.json and report.html, None: write nothing."""

    name: str
    path: Path
    out: Path | None
    held_out: float
    seed: int


@dataclass(frozen=True)
class Row:
    """Holds the outcome of a recording: ``report`` is its JSON; ``error`` says why there is none.

    ``bad_input`` is True if the recording is at fault, False if the engine is.
    """

    name: str
    path: str
    report: dict[str, Any] | None = None
    error: str = ""
    bad_input: bool = False

    @property
    def cells(self) -> dict[str, str]:
        """Return the columns of the table, for the output with the largest residual over its noise."""
        if self.report is None:
            return {"name": self.name, "error": self.error}
        fit = self.report["fit"]
        worst = max(fit["unit"], key=lambda o: fit["recalibrated_rms"][o] / max(fit["noise_floor_rms"][o], 1e-300))
        factor, unit = scaled(
            fit["recalibrated_rms"][worst], fit["unit"][worst], fit.get("file_unit", {}).get(worst, "")
        )
        return {
            "name": self.name,
            "error": "",
            "verdict": self.report["verdict"],
            "physics": ", ".join(words(p["name"]) for p in self.report["physics"]),
            "output": f"{worst} ({unit})",
            "recalibrated": number(fit["recalibrated_rms"][worst] * factor),
            "fitted": number(fit["fitted_rms"][worst] * factor),
            "noise": number(fit["noise_floor_rms"][worst] * factor),
            "seconds": f"{self.report['seconds']:.0f}",
        }


Work = Callable[[Job], Row]


def is_folder_of_recordings(path: Path) -> bool:
    """Return True for a folder without a recording.toml of its own."""
    return path.is_dir() and not (path / "recording.toml").is_file()


def find(folder: Path) -> dict[str, Path]:
    """Find the recordings below a folder, by name: every .toml that describes channels, and every unreadable one.

    Unreadable files are kept so that the table reports them. Raises InputError when there is no recording.
    """
    found: dict[str, Path] = {}
    for path in sorted(folder.rglob("*.toml")):
        try:
            if "channels" not in tomllib.loads(path.read_text(encoding="utf-8-sig")):
                continue
        except (OSError, ValueError, RecursionError):  # no TOML, no UTF-8, or no file that may be read
            pass
        name = path.relative_to(folder).with_suffix("")
        found[str(name.parent if name.name == "recording" else name)] = path
    if not found:
        raise InputError(f"{folder}: no recording.toml and no other recording below it; see docs/mismatch.md")
    return found


def jobs_for(recordings: dict[str, Path], out: Path | None, held_out: float, seed: int) -> list[Job]:
    """Return a job per recording, each with a folder of its own under ``out``."""
    return [
        Job(n, p.absolute(), None if out is None else (out / n).absolute(), held_out, seed)
        for n, p in recordings.items()
    ]


def diagnose_one(job: Job) -> Row:
    """Diagnose a recording in this process and write its reports. Never raises: a bad recording becomes a row."""
    from tools.mismatch.infer import diagnose
    from tools.mismatch.recording_load import load

    try:
        report = diagnose(load(job.path), held_out=job.held_out, seed=job.seed, jobs=1)
        if job.out is not None:
            write_reports(report, job.out)
        return Row(job.name, str(job.path), report.to_json())
    except NotTrusted as error:
        decide = shlex.join(["micron", "trust", str(error.subject)])
        more = "" if error.option == "--trust" else f" {error.option}"
        return Row(job.name, str(job.path), error=f"{error}; to allow it: {decide}{more}", bad_input=True)
    except (InputError, BenchError) as error:
        return Row(job.name, str(job.path), error=str(error), bad_input=True)
    except Exception as error:  # one recording that breaks the engine must not take the others with it
        return Row(job.name, str(job.path), error=f"the engine failed: {type(error).__name__}: {error}")


def write_reports(report: Report, folder: Path, page: str | None = None) -> None:
    """Write ``report.json`` and ``report.html`` (``page`` if given) to a folder, which is created if needed.

    Both are complete before either is written.
    """
    from tools.mismatch.report.page import html_page
    from tools.output import write_json, write_text_atomic

    page = html_page(report) if page is None else page
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror})") from error
    write_json(report.to_json(), str(folder / "report.json"))
    write_text_atomic(folder / "report.html", page)


def run_here(jobs: Sequence[Job], processes: int, work: Work = diagnose_one) -> Iterator[Row]:
    """Yield rows as they finish, from ``processes`` processes of this machine."""
    if processes <= 1 or len(jobs) == 1:
        yield from map(work, jobs)
        return
    from joblib import Parallel, delayed, parallel_config

    # loky sets OMP_NUM_THREADS and its relatives in the workers before they import numpy
    with parallel_config(backend="loky", inner_max_num_threads=1):
        rows = Parallel(n_jobs=processes, return_as="generator_unordered")(delayed(work)(job) for job in jobs)
        yield from cast(Iterator[Row], rows)


def run_on_dask(jobs: Sequence[Job], address: str, work: Work = diagnose_one) -> Iterator[Row]:
    """Yield rows as they finish, from the workers of a Dask cluster.

    Workers need this package and the same file system. A recording whose worker is lost goes to another one. Dask's
    nanny starts workers with one thread for linear algebra (its ``pre-spawn-environ``). Raises InputError as
    ``_client`` does.
    """
    with _client(address) as client, client.as_current():
        from distributed import as_completed

        futures = {
            client.submit(work, job, key=f"mismatch-{job.name}", retries=RETRIES, pure=False): job for job in jobs
        }
        for future in as_completed(list(futures)):
            job = futures[future]
            # a result that is lost with its worker is computed again elsewhere: both calls wait for that
            failure = future.exception()
            if failure is None:
                yield future.result()
            else:
                yield Row(job.name, str(job.path), error=f"lost on the cluster: {failure}")


@contextmanager
def on_cluster(address: str) -> Iterator[int]:
    """Let the engine's parallel work run on a Dask cluster inside this context, which gives the number of its threads.

    A piece of work whose worker is lost goes to another one. Raises InputError as ``_client`` does, and for a cluster
    without workers.
    """
    from joblib import parallel_config

    with _client(address) as client:
        from dask import config

        threads = sum(cast(dict[str, int], client.nthreads()).values())  # of a client that is not asynchronous
        if threads == 0:
            raise InputError(f"--dask {address}: the scheduler has no workers; start one: dask worker {address}")
        # what all pieces share is sent once as it is: Dask's advice to load it on the cluster does not apply
        quiet = config.set({"distributed.admin.large-graph-warning-threshold": "1 TB"})
        with quiet, parallel_config(backend="dask", client=client, retries=RETRIES, pure=False):
            yield threads


def _client(address: str) -> Client:
    """Connect to a Dask scheduler. Raises InputError when the extra is missing or nobody answers at ``address``."""
    if importlib.util.find_spec("distributed") is None:
        raise InputError("--dask needs the Dask client: pip install 'micron-bench[dask]'")
    from distributed import Client

    try:
        return Client(address, timeout="10s", set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise InputError(
            f"--dask {address}: no Dask scheduler answers there ({error}); start one or fix the address"
        ) from error


def to_json(folder: Path, rows: Sequence[Row]) -> dict[str, Any]:
    """Return the JSON that ``diagnose FOLDER --json`` writes."""
    return {
        "format": 1,
        "folder": str(folder),
        "recordings": [{k: v for k, v in asdict(r).items() if v not in (None, "")} for r in rows],
    }
