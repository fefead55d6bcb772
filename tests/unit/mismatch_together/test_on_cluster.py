"""Several recordings of one system on a Dask cluster: the same answer as on this machine, one message without one."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from hal.children import begin_as_worker
from tests.unit.clusters import local_cluster
from tests.unit.mismatch_together.test_together import refused, write
from tools.cli.main import app


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
