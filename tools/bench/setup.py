"""Answers requests of the Setup view: connected hardware, a draft of a bench file, its check, and a trial run."""

from __future__ import annotations

import asyncio
import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.routing import BaseRoute, Route

from tools.bench.dropped import run_module
from tools.bench.requests import body, clear, text
from tools.bench.session import Session
from tools.bench.setup_file import DAQS, OUTPUTS, Draft, bench_text, checked, read_draft
from tools.diagnose.scan import machine_ports, serial_ports
from tools.errors import InputError
from tools.output import write_text_atomic

_SCAN = """format = 1
name = "scan"
[clock]
tick_hz = 1000
[bus.scanned]
kind = "{kind}"
uri = {uri}
{speed}
"""
_SPEEDS = {"i2c": "speed_hz = 400_000", "can": "bitrate = 500_000"}


def found_uris(emulated: bool) -> dict[str, dict[str, str]]:
    """Return the URIs of every bus that this machine has by kind, each with what the machine knows of it.

    Serial ports are known by their USB descriptors: nothing is sent to them. The emulated bench has buses as well.
    """
    ports: dict[str, dict[str, str]] = {"serial": {}, "i2c": {}, "can": {}}
    products = {port.path: port.product for port in serial_ports()}
    for port in machine_ports():
        if "/i2c-" in port:
            ports["i2c"][f"linux-i2c://{port.rpartition('-')[2]}"] = ""
        elif port.startswith("/sys/class/net/"):
            ports["can"][f"socketcan://{Path(port).name}"] = ""
        else:
            ports["serial"][f"serial://{port}"] = products.get(port, "")
    if emulated:
        ports["serial"] |= {"sim://daq0": "emulated DI-4108", "sim://e7270": "emulated E-727"}
        ports["i2c"] |= {"sim://i2c0": "emulated", "sim://i2c1": "emulated"}
        ports["can"]["sim://can0"] = "emulated"
    return ports


class _Setup:
    """Answers the requests of the Setup view: find ports, scan a bus, check, write and try a bench file."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def routes(self) -> list[BaseRoute]:
        """Return the routes of the view."""
        return [
            Route("/api/setup", clear(self._found)),
            Route("/api/setup/scan", clear(self._scan), methods=["POST"]),
            Route("/api/setup/check", clear(self._check), methods=["POST"]),
            Route("/api/setup/write", clear(self._write), methods=["POST"]),
            Route("/api/setup/try", clear(self._attempt), methods=["POST"]),
        ]

    def _draft_text(self, draft: Draft) -> str:
        folder = self._session.home / "calibration"
        files = [folder / f"{n}.toml" for n in ("sensors", "piezo", "manipulator")]
        return bench_text(draft, [f"calibration/{p.name}" for p in files if p.is_file()])

    async def _found(self, _: Request) -> Any:
        emulated = bool(self._session.bench.description.emulated_buses())
        return {
            **found_uris(emulated),
            "daqs": DAQS,
            "outputs": {name: [title, bus] for name, (title, bus, _) in OUTPUTS.items()},
            "folder": str(self._session.home),
        }

    async def _scan(self, request: Request) -> Any:
        """Look for addresses on one I2C bus, or listen to one CAN bus.

        The former reads a byte from each address, so that the bus must not be in use; the latter sends nothing.
        """
        uri = text(await body(request), "uri", longest=100)
        ports = found_uris(bool(self._session.bench.description.emulated_buses()))
        kind = next((k for k in _SPEEDS if uri in ports[k]), None)
        if kind is None:
            raise InputError(f"{uri!r} is not an I2C or CAN bus of this machine")
        busy = [name for name, spec in self._session.bench.description.bus.items() if spec.uri == uri]
        emulated = uri.startswith("sim://")
        if kind == "i2c" and busy and not emulated and self._session.run.phase in ("starting", "running"):
            raise InputError(f"the running bench uses {uri} ({busy[0]}); press Safe state first, then scan")
        with tempfile.TemporaryDirectory(prefix="micron-scan-") as folder:
            bench, answer = Path(folder) / "scan.toml", Path(folder) / "found.json"
            content = _SCAN.format(kind=kind, uri=json.dumps(uri), speed=_SPEEDS[kind])
            bench.write_text(content, encoding="utf-8")
            # emulated devices are those of the bench that runs; a second emulated world answers for it
            what = [str(self._session.choice.bench), "--virtual"] if emulated else [str(bench)]
            await run_module("tools.cli.main", "scan", "--bench", *what, "--json", str(answer))
            answers = json.loads(answer.read_text(encoding="utf-8"))
        bus = busy[0] if emulated and busy else "scanned"
        return {
            "uri": uri,
            "kind": kind,
            "addresses": [a["address"] for a in answers["i2c"] if a["answered"] and a["bus"] == bus],
            "frames": [[c["can_id"], c["name"], c["rate_hz"]] for c in answers["can"] if c["bus"] == bus],
        }

    async def _check(self, request: Request) -> Any:
        content = self._draft_text(read_draft(await body(request)))
        return {"text": content, "findings": await asyncio.to_thread(checked, content, self._session.home)}

    async def _write(self, request: Request) -> Any:
        """Write the bench file beside the others; never over one."""
        draft = read_draft(await body(request))
        path = self._session.home / f"{draft.name}.toml"
        if path.exists() or path.is_symlink():
            raise InputError(f"{path} is there already; choose another name")
        content = self._draft_text(draft)
        findings = await asyncio.to_thread(checked, content, self._session.home)
        write_text_atomic(path, content)
        self._session.note("info", f"Setup wrote {path}")
        return {"path": str(path), "text": content, "findings": findings}

    async def _attempt(self, request: Request) -> Any:
        """Start the firmware with the written file, sensing only: nothing is armed while wiring is checked."""
        name = text(await body(request), "path", longest=1000)
        path = next((p for p in self._session.home.glob("*.toml") if str(p) == name), None)
        if path is None:
            raise InputError(f"{name} is not one of the benches in {self._session.home}")
        if self._session.recorder.active:
            raise InputError("a recording is running; stop it first: the firmware starts again")
        await self._session.start(replace(self._session.choice, bench=path, sense_only=True, compiled=False))


def setup_routes(session: Session) -> list[BaseRoute]:
    """Return the routes of the Setup view."""
    return _Setup(session).routes()
