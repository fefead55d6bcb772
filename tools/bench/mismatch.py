"""Requests of the Mismatch view: a recording, its twin, the engine in a process of its own, report, corrected twin."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import FileResponse
from starlette.routing import BaseRoute, Route

from tools.bench.jobs import Jobs
from tools.bench.recorder import SUFFIX
from tools.bench.requests import body, clear, text
from tools.bench.session import Session
from tools.errors import InputError

DEMONSTRATION = "demonstration: an emulated stack under the interferometer"


def mismatch_routes(session: Session, jobs: Jobs) -> list[BaseRoute]:
    folder = session.recorder.folder

    def choices() -> dict[str, Path]:
        files = {p.name: p for p in sorted(folder.glob(f"*{SUFFIX}"))}
        return files | {f"{p.parent.name}/": p.parent for p in sorted(folder.glob("*/recording.toml"))}

    async def recordings(_: Request) -> Any:
        names = [*choices(), *([DEMONSTRATION] if session.bench.description.emulated_buses() else [])]
        return {"recordings": names, "job": jobs.state("mismatch"), "folder": str(folder)}

    async def start(request: Request) -> Any:
        name = text(await body(request), "recording")
        work = jobs.new_folder()
        steps: list[list[str]] = []
        source = choices().get(name)
        if name == DEMONSTRATION:
            source = work / "stack"
            bench = str(session.choice.bench)
            options = ("--profile", "sawtooth", "--seconds", "10", "--out", str(source))
            steps.append(["sim_devices.plant.lab", "piezo", "--bench", bench, *options])
        elif source is None:
            raise InputError(f"there is no recording {name!r} in {folder}")
        elif source.suffix == SUFFIX:
            out = str(work / "recording")
            steps.append(["tools.cli.main", "export", str(source), "--out", out])
            source = Path(out)
        report = ("--html", str(work / "report.html"), "--json", str(work / "report.json"), "--jobs", "1")
        steps.append(["tools.cli.main", "mismatch", "diagnose", str(source), *report])
        twin = str(work / "twin.toml")
        steps.append(["tools.cli.main", "mismatch", "apply", str(source), str(work / "report.json"), "--out", twin])
        return jobs.start("mismatch", f"diagnose {name}", steps, work).as_dict()

    return [
        Route("/api/mismatch", clear(recordings)),
        Route("/api/mismatch/start", clear(start), methods=["POST"]),
        *job_routes(jobs),
    ]


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
