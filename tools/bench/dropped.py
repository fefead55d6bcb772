"""Handles data files dropped into the Mismatch view: a person describes them, then they become a recording folder."""

from __future__ import annotations

import asyncio
import json
import re
import shutil
import tomllib
from dataclasses import asdict
from pathlib import Path
from typing import Any

from starlette.requests import ClientDisconnect, Request
from starlette.routing import BaseRoute, Route

from hal.children import child_command, child_environment
from tools.bench.dropped_files import Dropped
from tools.bench.guard import MAX_UPLOAD_BYTES
from tools.bench.recorder import SUFFIX, check_name, is_own_file
from tools.bench.requests import body, clear, text
from tools.bench.session import Session
from tools.errors import InputError
from tools.mismatch.key_tables import of_kind
from tools.mismatch.recording_columns import SUFFIXES
from tools.mismatch.twins.vocabulary import KINDS
from tools.output import write_text_atomic
from tools.toml_text import toml_text

OFFERED = (
    "piezo_stack",
    "mechanical_axis",
    "accelerometer",
    "magnetometer",
    "accelerometer_cluster",
    "state_space",
    "ode",
    "columns",
    "instrument",
    "fmu",
)
NEEDS_FILE = {"instrument": "bench", "fmu": "path"}
"""Parameter of a kind that names a file: one that lies on this machine already is chosen and copied beside the data. No
program comes in by the page, and one that is named there runs after ``micron trust`` alone."""
IDLE_S = 20.0
READ_S = 120.0
_WORD = re.compile(r"[A-Za-z][\w./ -]*")


async def run_module(*arguments: str) -> str:
    """Run a module of ours beside the loop and return its output. ``InputError`` with its message when it refuses."""
    process = await asyncio.create_subprocess_exec(
        *child_command(*arguments),
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
        env=child_environment(),
    )
    try:
        out, stderr = await asyncio.wait_for(process.communicate(), READ_S)
    except BaseException as error:
        process.kill()
        await process.wait()
        if isinstance(error, TimeoutError):
            raise InputError(f"the file was not read within {READ_S:.0f} s; cut it into parts") from None
        raise
    if process.returncode:
        lines = stderr.decode(errors="replace").strip().splitlines()
        raise InputError(lines[-1] if lines else f"the file could not be read (status {process.returncode})")
    return out.decode()


def parameter_value(name: str, text_value: str) -> Any:
    """Return the value that a person typed: a number, a list, a table, true, or a word. ``InputError`` otherwise."""
    try:
        table = tomllib.loads(f"value = {text_value}")
        if list(table) == ["value"]:
            return table["value"]
    except tomllib.TOMLDecodeError:
        if _WORD.fullmatch(text_value):
            return text_value
    raise InputError(f"parameter {name}: {text_value!r} is no number, list or word; write numbers as 2.1")


def files_of(session: Session, kind: str) -> dict[str, Path]:
    """Return the files that a twin of this kind can name: benches beside the running one, FMUs among the recordings."""
    folder, pattern = {
        "instrument": (session.home, "*.toml"),
        "fmu": (session.recorder.folder, "*.fmu"),
    }[kind]
    files = sorted(folder.glob(pattern), key=lambda path: (path != session.choice.bench, path.name))
    return {path.name: path for path in files if is_own_file(path)}  # the running bench comes first


def description(table: dict[str, Any], data: str) -> dict[str, Any]:
    """Return the ``recording.toml`` that the form describes. ``InputError`` names the field that is wrong."""
    kind = text(table, "kind")
    if kind not in OFFERED:
        raise InputError(f"choose a kind of twin: {', '.join(OFFERED)}")
    given = table.get("parameters", {})
    channels = table.get("channels", [])
    if not isinstance(given, dict) or not isinstance(channels, list) or not all(isinstance(c, dict) for c in channels):
        raise InputError("parameters must be an object and channels a list of objects")
    typed = {key: value for key, value in given.items() if isinstance(value, str) and value.strip()}
    for line in filter(str.strip, text(table, "others").splitlines()):
        key, sign, value = line.partition("=")
        if not sign or not key.strip() or key.strip() in typed:
            raise InputError(f"other parameters: {line.strip()!r} is not a new name = value; write one a line")
        typed[key.strip()] = value
    parameters = {key: parameter_value(key, value.strip()) for key, value in typed.items()}
    descriptor: dict[str, Any] = {"format": 1, "title": text(table, "title", longest=200) or data, "data": data}
    if clock := text(table, "time_column", longest=200):
        descriptor["time_column"] = clock
    rate = table.get("rate_hz")
    if rate is not None:
        if isinstance(rate, bool) or not isinstance(rate, int | float) or not 0 < rate < 1e9:
            raise InputError("the rate must be a number of samples per second")
        descriptor["rate_hz"] = float(rate)
    elif not clock:
        raise InputError("say which column is the time, or give the rate")
    descriptor["twin"] = {"kind": kind, "parameters": parameters}
    descriptor["channels"] = []
    for channel in channels:
        one: dict[str, Any] = {k: text(channel, k, longest=200) for k in ("column", "role", "signal", "unit")}
        if not one["unit"]:
            del one["unit"]
        noise = channel.get("noise_rms")
        if isinstance(noise, int | float) and not isinstance(noise, bool):
            one["noise_rms"] = float(noise)
        descriptor["channels"].append(one)
    return descriptor


def dropped_routes(session: Session, dropped: Dropped) -> list[BaseRoute]:
    recordings = session.recorder.folder

    async def upload(request: Request) -> Any:
        """Take a file in parts. Nothing of it is kept unless it is whole and can be read."""
        name = Path(request.path_params["name"]).name
        number, path = dropped.new_file(name)
        try:
            await _receive(request, path, name)
            if path.suffix == SUFFIX and await asyncio.to_thread(_is_own_recording, path):
                kept = recordings / (check_name(Path(name).stem) + SUFFIX)
                if kept.exists() or kept.is_symlink():
                    raise InputError(f"there is a recording {kept.stem!r} already; rename the file")
                path.rename(kept)
                shutil.rmtree(path.parent, ignore_errors=True)
                return {"recording": kept.name}
            guess = json.loads(await run_module("tools.mismatch.guess", str(path)))
        except BaseException as error:
            shutil.rmtree(path.parent, ignore_errors=True)
            if isinstance(error, InputError):
                raise InputError(str(error).replace(str(path), name)) from None
            raise
        dropped.files[number] = path
        return {"number": number, "name": name, **guess}

    async def describe(request: Request) -> Any:
        """Write the recording folder; what is wrong is one message, and the file stays for the next try."""
        table = await body(request)
        path = dropped.get(text(table, "number"))
        title = check_name(text(table, "name", longest=80))
        target = recordings / title
        if target.exists() or target.is_symlink():
            raise InputError(f"there is a recording {title!r} already; choose another name")
        described = description(table, path.name)
        _bring_file(session, described["twin"], path.parent)
        descriptor = path.with_name("recording.toml")
        write_text_atomic(descriptor, toml_text(described))
        try:
            await run_module("tools.mismatch.guess", "--check", str(descriptor))
        except InputError as error:
            message = re.sub(r"\[\[channels\]\] \d+ \((.*?)\)", r"column \1", str(error))
            raise InputError(message.replace(f"{descriptor}: ", "").replace(f"{path}: ", "")) from None
        path.parent.rename(target)
        dropped.files.pop(text(table, "number"), None)
        return {"recording": f"{title}/"}

    async def kinds(_: Request) -> Any:
        files = {kind: list(files_of(session, kind)) for kind in NEEDS_FILE}
        # the first look imports the twins' modules: meanwhile the loop has frames to send and orders to obey
        kinds = await asyncio.to_thread(lambda: [_kind(kind, files.get(kind)) for kind in OFFERED])
        return {"kinds": kinds, "most_bytes": MAX_UPLOAD_BYTES, "suffixes": SUFFIXES}

    return [
        Route("/api/upload/{name}", clear(upload), methods=["PUT"]),
        Route("/api/mismatch/kinds", clear(kinds)),
        Route("/api/mismatch/new", clear(describe), methods=["POST"]),
    ]


def _bring_file(session: Session, twin: dict[str, Any], folder: Path) -> None:
    """Copy the file that the twin names beside the data. ``InputError``: it was not offered."""
    key = NEEDS_FILE.get(twin["kind"])
    if key is None:
        return
    offered = files_of(session, twin["kind"])
    name = twin["parameters"].get(key)
    if name not in offered:
        where = "among the recordings" if twin["kind"] == "fmu" else f"in {session.home}"
        raise InputError(f"parameter {key}: choose one of the files {where}: {', '.join(offered) or 'there are none'}")
    shutil.copyfile(offered[name], folder / name)


def _kind(kind: str, files: list[str] | None) -> dict[str, Any]:
    words = KINDS[kind]
    keys = of_kind(kind)
    return {
        "kind": kind,
        "file_key": NEEDS_FILE.get(kind, ""),
        "files": files or [],
        "inputs": [[p, list(u)] for p, u in words.inputs],
        "outputs": [[p, list(u)] for p, u in words.outputs],
        "keys": [asdict(key) for key in keys if key.name.isidentifier()],
        "others": next((key.name for key in keys if not key.name.isidentifier()), ""),
    }


async def _receive(request: Request, path: Path, name: str) -> None:
    size = 0
    parts = request.stream().__aiter__()
    try:
        with path.open("xb") as file:
            while True:
                part = await asyncio.wait_for(anext(parts, None), IDLE_S)
                if part is None:
                    break
                size += len(part)
                if size > MAX_UPLOAD_BYTES:
                    raise InputError(f"{name} is larger than {MAX_UPLOAD_BYTES // 1_000_000} MB; {LARGER}")
                await asyncio.to_thread(file.write, part)
    except (TimeoutError, ClientDisconnect):
        raise InputError(f"{name} did not arrive whole; drop it again") from None
    if not size:
        raise InputError(f"{name} is empty")


LARGER = "put it into a folder of the recordings with a recording.toml beside it (docs/own-data.md)"


def _is_own_recording(path: Path) -> bool:
    """Return whether a file is a recording of this program. Raises ``InputError`` for one that was torn."""
    from firmware_py.recording.errors import RecordingError
    from firmware_py.recording.index import IndexedRecording
    from firmware_py.recording.reader import Recording

    try:
        IndexedRecording(path).close()
    except RecordingError as torn:
        try:
            Recording(path)
        except RecordingError:
            return False
        raise InputError(str(torn)) from torn
    return True
