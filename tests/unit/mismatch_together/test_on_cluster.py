"""Several recordings of one system on a Dask cluster: the same answer as on this machine, one message without one."""

from __future__ import annotations

import json
import os
import signal
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from hal.children import begin_as_worker
from tests.unit.clusters import local_cluster
from tests.unit.mismatch_together.test_together import refused, write
from tools.cli.main import app
from tools.mismatch.batch import on_cluster
from tools.mismatch.engine import workers
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.split import Split
from tools.mismatch.recording_load import load
from tools.mismatch.twins.make import make


def diagnosed(runs: Path, out: Path, *more: str) -> dict[str, Any]:
    arguments = ["mismatch", "diagnose", str(runs), "--together", "--json", str(out), *more]
    found = CliRunner().invoke(app, arguments)
    assert found.exit_code == 0, found.output
    report = json.loads(out.read_text())
    report.pop("seconds")
    return report


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_cluster_gives_the_answer_of_one_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    distributed = pytest.importorskip("distributed")
    runs = tmp_path / "runs"
    for k in range(4):
        write(runs / f"day{k}", k, play=0.0015, n=600)
    here = diagnosed(runs, tmp_path / "here.json", "--jobs", "1")
    monkeypatch.setattr("tools.mismatch.engine.workers.LEAST_WORK", 0)
    with local_cluster(2) as cluster:
        there = diagnosed(runs, tmp_path / "there.json", "--dask", cluster.scheduler_address)
        with distributed.Client(cluster, set_as_default=False) as client:
            finished = client.run_on_scheduler(lambda dask_scheduler: dask_scheduler.transition_counter)
    assert here == there
    assert finished > 100  # the pieces ran there


def dies_first(shared: np.ndarray, marker: Path, piece: int) -> tuple[float, int]:
    """The first process that is given the third piece is killed in the middle of it."""
    if piece == 2 and not marker.exists():
        marker.write_text(str(os.getpid()))
        os.kill(os.getpid(), signal.SIGKILL)
    return float(shared[piece]), os.getpid()


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_pieces_and_what_they_share_survive_a_killed_worker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "run", 0, n=100)
    joined = load(tmp_path / "run")
    problem = Problem(joined, make(joined), Split(100, ((0, 100),), (), (), ()), 0, 0)
    monkeypatch.setattr(workers, "LEAST_SAMPLES", 0)
    shared, marker = np.arange(1e5), tmp_path / "killed"
    with local_cluster(2) as cluster, on_cluster(cluster.scheduler_address) as threads:
        found = workers.mapped(problem, dies_first, [(shared, marker, k) for k in range(8)], threads)
    assert [value for value, _ in found] == [float(k) for k in range(8)]
    assert marker.read_text() != str(found[2][1])


@pytest.mark.slow
def test_a_cluster_without_workers_is_one_message(tmp_path: Path) -> None:
    for k in range(2):
        write(tmp_path / f"day{k}", k, n=100)
    with local_cluster(0) as cluster:
        output = refused(tmp_path, "--together", "--dask", cluster.scheduler_address)
    assert "the scheduler has no workers; start one: dask worker" in output


def test_a_thread_of_a_cluster_keeps_the_signals_of_its_process() -> None:
    failed: list[BaseException] = []

    def work() -> None:
        try:
            begin_as_worker()  # signal.signal raises outside the main thread
        except ValueError as error:
            failed.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert failed == []
