"""Long work in processes of its own: one at a time, progress in words, files kept, cancelled as a whole."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

from tools.bench.jobs import Jobs
from tools.errors import InputError

MODULE = "micron_job_step"
SOURCE = """
import pathlib, signal, sys
what, folder = sys.argv[1], pathlib.Path(sys.argv[2])
print("\\x1b[1mbegin\\x1b[0m", what, flush=True)
(folder / f"{what}.txt").write_text(what)
if what == "wait":
    signal.pause()
sys.exit({"fail": 2, "lossy": 3}.get(what, 0))
"""


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[Jobs], Awaitable[None]]], None]:
    (tmp_path / f"{MODULE}.py").write_text(SOURCE)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    def go(body: Callable[[Jobs], Awaitable[None]]) -> None:
        async def whole() -> None:
            jobs = Jobs()
            try:
                await asyncio.wait_for(body(jobs), 60)
            finally:
                await jobs.close()

        asyncio.run(whole())

    return go


def test_steps_one_after_the_other_and_the_files_they_leave(run: Callable[..., None]):
    async def body(jobs: Jobs) -> None:
        folder = jobs.new_folder()
        job = jobs.start("export", "two steps", [[MODULE, "lossy", str(folder)], [MODULE, "one", str(folder)]], folder)
        await job.task
        state = jobs.state("export")
        assert (state["state"], state["code"], state["step"]) == ("done", 0, 1)
        assert state["lines"] == ["begin lossy", "begin one"]  # without the terminal's colours
        assert state["files"] == ["lossy.txt", "one.txt"]
        assert jobs.file("export", "one.txt").read_text() == "one"
        for name in ("../../etc/passwd", "two.txt"):
            with pytest.raises(InputError, match="no file"):
                jobs.file("export", name)

    run(body)


def test_the_first_step_that_fails_ends_it(run: Callable[..., None]):
    async def body(jobs: Jobs) -> None:
        folder = jobs.new_folder()
        job = jobs.start("export", "fails", [[MODULE, "fail", str(folder)], [MODULE, "one", str(folder)]], folder)
        await job.task
        assert (job.state, job.code) == ("failed", 2)
        assert not (folder / "one.txt").exists()

    run(body)


def test_one_at_a_time_and_a_cancelled_one_makes_room(run: Callable[..., None]):
    async def body(jobs: Jobs) -> None:
        folder = jobs.new_folder()
        job = jobs.start("mismatch", "waits", [[MODULE, "wait", str(folder)]], folder)
        with pytest.raises(InputError, match="'waits' is still running"):
            jobs.start("calibrate", "another", [], jobs.new_folder())
        await job.cancel()  # before its process is there: it must end all the same
        assert job.state == "cancelled"
        jobs.must_be_idle()
        steps = [[MODULE, "wait", str(folder)], [MODULE, "one", str(folder)]]
        job = jobs.start("calibrate", "waits in its first step", steps, folder)
        while not job.lines:
            await asyncio.sleep(0.01)
        await job.cancel()
        assert job.state == "cancelled"
        assert not (folder / "one.txt").exists()

    run(body)
