"""Answers requests of the Mismatch view: it runs the engine in a process of its own and serves report and twin."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import FileResponse
from starlette.routing import BaseRoute, Route

from tools.bench.applied import Applied
from tools.bench.jobs import Jobs
from tools.bench.recorder import SUFFIX, is_own_file
from tools.bench.requests import body, clear, text
from tools.bench.session import Session
from tools.errors import InputError

SECONDS = 10.0
DEMONSTRATION = "demonstration: an emulated stack under the interferometer"


def figures(run: Path) -> dict[str, Any]:
    """A run's JSON on the tip, um rms: tremor in 8-12 Hz without and with compensation, error in all bands."""
    tremor = json.loads(run.read_text(encoding="utf-8"))["tremor"]
    return {
        "band": [tremor["uncompensated_rms_um"], tremor["compensated_rms_um"], tremor["reduction_percent"]],
        "all": [tremor["whole_band_error"][k] for k in ("uncompensated_rms_um", "compensated_rms_um")],
    }


class _Mismatch:
    """Answers the requests of the Mismatch view: diagnose a recording, put its corrected twin on the bench, compare."""

    def __init__(self, session: Session, jobs: Jobs, applied: Applied) -> None:
        self._session = session
        self._jobs = jobs
        self._applied = applied
        self._folder = session.recorder.folder

    def routes(self) -> list[BaseRoute]:
        """Return the routes of the view."""
        return [
            Route("/api/mismatch", clear(self._recordings)),
            Route("/api/mismatch/start", clear(self._start), methods=["POST"]),
            Route("/api/mismatch/last-minute", clear(self._last_minute), methods=["POST"]),
            Route("/api/mismatch/apply", clear(self._apply), methods=["POST"]),
            Route("/api/mismatch/difference", clear(self._difference)),
            *job_routes(self._jobs),
        ]

    def _choices(self) -> dict[str, Path]:
        files = {p.name: p for p in sorted(self._folder.glob(f"*{SUFFIX}")) if is_own_file(p)}
        folders = (p.parent for p in sorted(self._folder.glob("*/recording.toml")))
        own = (p for p in folders if not any(q.is_symlink() for q in (p, *p.iterdir())))
        return files | {f"{p.name}/": p for p in own}

    async def _recordings(self, _: Request) -> Any:
        names = [*self._choices(), *([DEMONSTRATION] if self._session.bench.description.emulated_buses() else [])]
        return {
            "recordings": names,
            "job": self._jobs.state("mismatch"),
            "folder": str(self._folder),
            "applied": self._applied.what,
            "difference": self._jobs.state("difference"),
        }

    async def _start(self, request: Request) -> Any:
        name = text(await body(request), "recording")
        work = self._jobs.new_folder()
        steps: list[list[str]] = []
        source = self._choices().get(name)
        if name == DEMONSTRATION:
            source = work / "stack"
            bench = str(self._session.choice.bench)
            options = ("--profile", "sawtooth", "--seconds", "10", "--out", str(source))
            steps.append(["sim_devices.plant.lab", "piezo", "--bench", bench, *options])
        elif source is None:
            raise InputError(f"there is no recording {name!r} in {self._folder}")
        elif source.suffix == SUFFIX:
            out = str(work / "recording")
            steps.append(["tools.cli.main", "export", str(source), "--out", out])
            source = Path(out)
        return self._diagnose(source, f"diagnose {name}", steps, work)

    def _diagnose(self, source: Path, title: str, steps: list[list[str]], work: Path) -> Any:
        report = ("--html", str(work / "report.html"), "--json", str(work / "report.json"), "--jobs", "1")
        steps.append(["tools.cli.main", "mismatch", "diagnose", str(source), *report])
        twin = str(work / "twin.toml")
        steps.append(["tools.cli.main", "mismatch", "apply", str(source), str(work / "report.json"), "--out", twin])
        return self._jobs.start("mismatch", title, steps, work).as_dict()

    async def _last_minute(self, _: Request) -> Any:
        """Diagnose what the watching twin saw last."""
        self._jobs.must_be_idle()
        work = self._jobs.new_folder()
        source = await asyncio.to_thread(
            self._session.watch.write_last_minute, self._session.history, work / "recording"
        )
        return self._diagnose(source, "diagnose the last minute", [], work)

    async def _apply(self, _: Request) -> Any:
        """The corrected twin in the place of the emulated stacks; then both benches in virtual time, side by side."""
        twin = self._jobs.file("mismatch", "twin.toml")
        self._jobs.must_be_idle()
        choice = self._session.choice
        after = await self._applied.twin(twin)
        work = self._jobs.new_folder()
        same = ["--virtual", "--seconds", f"{SECONDS:g}"]
        if choice.hand_file:
            same += ["--hand", choice.hand_file]
        if choice.seed is not None:
            same += ["--seed", str(choice.seed)]
        steps: list[list[str]] = []
        for name, bench in (("before", choice.bench), ("after", after)):
            files = ("--json", str(work / f"{name}.json"), "--picture", str(work / f"{name}.png"))
            steps.append(["tools.cli.main", "run", "--bench", str(bench), *same, *files])
        return self._jobs.start("difference", "both benches in virtual time", steps, work).as_dict()

    async def _difference(self, _: Request) -> Any:
        """Return the available figures on the emulated truth, without and with the corrected twin."""
        job = self._jobs.state("difference")
        result: dict[str, Any] = {"job": job}
        for name in ("before", "after"):
            if f"{name}.json" in job.get("files", ()):
                result[name] = figures(self._jobs.file("difference", f"{name}.json"))
        return result


def mismatch_routes(session: Session, jobs: Jobs, applied: Applied) -> list[BaseRoute]:
    """Return the routes of the Mismatch view."""
    return _Mismatch(session, jobs, applied).routes()


def job_routes(jobs: Jobs) -> list[BaseRoute]:
    """State, files and end of any job."""

    async def state(request: Request) -> Any:
        return jobs.state(request.path_params["kind"])

    async def cancel(request: Request) -> Any:
        await jobs.get(request.path_params["kind"]).cancel()

    async def file(request: Request) -> Any:
        name = request.path_params["name"]
        return FileResponse(jobs.file(request.path_params["kind"], name), filename=name)

    return [
        Route("/api/jobs/{kind}", clear(state)),
        Route("/api/jobs/{kind}/cancel", clear(cancel), methods=["POST"]),
        Route("/api/jobs/{kind}/files/{name}", clear(file)),
    ]
