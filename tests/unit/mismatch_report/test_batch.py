"""A folder of recordings: found, diagnosed side by side here and on a Dask cluster, none lost."""

import json
import os
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.unit.clusters import local_cluster
from tests.unit.mismatch_report.canned import missing_physics
from tests.unit.mismatch_report.systems import recording
from tools.errors import InputError
from tools.mismatch import batch
from tools.mismatch.batch import Job, Row


def stack(folder: Path, seed: int = 1) -> Path:
    return recording(folder, change=lambda u, t: 0.125 * u - 1.0, seed=seed, samples=400)


def test_recordings_are_found_by_what_they_describe(tmp_path: Path):
    stack(tmp_path / "a")
    stack(tmp_path / "deep" / "b")
    (tmp_path / "flat.toml").write_text((tmp_path / "a" / "recording.toml").read_text())
    (tmp_path / "meta.toml").write_text('title = "not a recording"\n')
    (tmp_path / "broken.toml").write_text("format = = 1\n")
    assert list(batch.find(tmp_path)) == ["a", "broken", "deep/b", "flat"]
    assert batch.is_folder_of_recordings(tmp_path)
    assert not batch.is_folder_of_recordings(tmp_path / "a")
    assert not batch.is_folder_of_recordings(tmp_path / "flat.toml")


def test_an_empty_folder_is_bad_input(tmp_path: Path):
    with pytest.raises(InputError, match=r"no recording\.toml"):
        batch.find(tmp_path)


@pytest.fixture
def canned_engine(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("tools.mismatch.infer.diagnose", lambda rec, **_: replace(missing_physics(), pictures=None))


def test_every_recording_gets_its_reports_and_a_bad_one_a_row(tmp_path: Path, canned_engine: None):
    stack(tmp_path / "in" / "good")
    bad = stack(tmp_path / "in" / "bad")
    bad.write_text(bad.read_text().replace('unit = "V"', 'unit = "parsec"'))
    rows = list(batch.run_here(batch.jobs_for(batch.find(tmp_path / "in"), tmp_path / "out", 0.3, 0), 1))
    bad_row, good_row = sorted(rows, key=lambda r: r.name)
    assert bad_row.bad_input
    assert "parsec" in bad_row.error
    assert good_row.report == json.loads((tmp_path / "out" / "good" / "report.json").read_text())
    assert "<!doctype html>" in (tmp_path / "out" / "good" / "report.html").read_text()
    assert not (tmp_path / "out" / "bad").exists()
    body = batch.to_json(tmp_path / "in", rows)
    assert [set(r) for r in body["recordings"]] == [
        {"name", "path", "error", "bad_input"},
        {"name", "path", "report", "bad_input"},
    ]


def test_an_engine_that_breaks_loses_one_recording_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def breaks_once(rec, **_):
        if rec.path.parent.name == "a":
            raise np.linalg.LinAlgError("singular")
        return missing_physics()

    monkeypatch.setattr("tools.mismatch.infer.diagnose", breaks_once)
    stack(tmp_path / "a")
    stack(tmp_path / "b")
    a, b = batch.run_here(batch.jobs_for(batch.find(tmp_path), None, 0.3, 0), 1)
    assert a.error == "the engine failed: LinAlgError: singular"
    assert not a.bad_input
    assert b.report is not None


def with_threads(job: Job) -> Row:
    """Says what the process it ran in may use; in place of a diagnosis."""
    return Row(job.name, str(job.path), {"pid": os.getpid(), "threads": os.environ.get("OMP_NUM_THREADS")})


def test_processes_have_one_thread_each(tmp_path: Path):
    jobs = [Job(f"r{i}", tmp_path, None, 0.3, 0) for i in range(4)]
    rows = list(batch.run_here(jobs, 2, with_threads))
    assert sorted(r.name for r in rows) == ["r0", "r1", "r2", "r3"]
    assert {r.report["threads"] for r in rows} == {"1"}
    assert os.getpid() not in {r.report["pid"] for r in rows}


def dies_first(job: Job) -> Row:
    """The first process that is given the recording 'r2' is killed in the middle of it."""
    marker = job.path / "killed"
    if job.name == "r2" and not marker.exists():
        marker.write_text(str(os.getpid()))
        os.kill(os.getpid(), signal.SIGKILL)
    return with_threads(job)


@pytest.mark.slow
def test_a_dask_cluster_of_two_survives_a_killed_worker(tmp_path: Path):
    jobs = [Job(f"r{i}", tmp_path, None, 0.3, 0) for i in range(6)]
    with local_cluster(2) as cluster:
        rows = list(batch.run_on_dask(jobs, cluster.scheduler_address, dies_first))
    killed = (tmp_path / "killed").read_text()
    assert sorted(r.name for r in rows) == [f"r{i}" for i in range(6)]
    assert [r.error for r in rows] == [""] * 6
    assert killed not in {str(r.report["pid"]) for r in rows if r.name == "r2"}
    assert {r.report["threads"] for r in rows} == {"1"}


class LostOnce:
    """A future that was done, whose result died with its worker, and is worked out again."""

    status = "pending"

    def __init__(self, row: Row) -> None:
        self.row = row

    def exception(self) -> None:
        self.status = "finished"

    def result(self) -> Row:
        assert self.status == "finished"
        return self.row


class OneFuture:
    """A Dask client that hands out such futures."""

    def __init__(self, *args: object, **more: object) -> None:
        pass

    __enter__ = as_current = lambda self: self

    def __exit__(self, *why: object) -> None:
        pass

    def submit(self, work: object, job: Job, **more: object) -> LostOnce:
        return LostOnce(Row(job.name, str(job.path)))


def test_a_result_that_dies_with_its_worker_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("distributed.Client", OneFuture)
    monkeypatch.setattr("distributed.as_completed", list)
    (row,) = batch.run_on_dask([Job("r0", tmp_path, None, 0.3, 0)], "tcp://127.0.0.1:1")
    assert (row.name, row.error) == ("r0", "")


def test_without_the_extra_the_message_says_what_to_install(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"micron-bench\[dask\]"):
        list(batch.run_on_dask([], "tcp://127.0.0.1:1"))
