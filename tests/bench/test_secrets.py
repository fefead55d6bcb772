"""The token is shown once, on standard error, to whoever started the page, and is written or said nowhere else."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path

import pytest

from tests.bench.conftest import Server
from tests.conftest import DEFAULT_BENCH

pytestmark = pytest.mark.timeout(300)


def descendants(pid: int) -> list[int]:
    """``pid`` and its children, theirs, and so on."""
    found = [pid]
    for number in found:
        try:
            text = Path(f"/proc/{number}/task/{number}/children").read_text()
        except FileNotFoundError:  # gone meanwhile
            continue
        found += [int(word) for word in text.split()]
    return found


def ask(base: str, path: str, headers: dict[str, str], body: bytes | None) -> str:
    """What is answered, whatever the status."""
    request = urllib.request.Request(base + path, body, headers, method="GET" if body is None else "POST")
    try:
        with urllib.request.urlopen(request, timeout=30) as answer:
            return f"{answer.headers}{answer.read().decode(errors='replace')}"
    except urllib.error.HTTPError as error:
        with error:
            return f"{error.headers}{error.read().decode(errors='replace')}"


def test_output_shows_it_once_and_no_answer_repeats_it(tmp_path: Path):
    """With good and bad tokens, good and bad requests; nothing that the server says or writes has the token."""
    from websockets.sync.client import connect

    command = [sys.executable, "-m", "tools.cli.main", "bench", "--port", "0", "--bench", str(DEFAULT_BENCH)]
    process = subprocess.Popen(
        [*command, "--recordings", str(tmp_path / "recordings")],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "TMPDIR": str(tmp_path), "COLUMNS": "400"},
    )
    try:
        assert process.stderr is not None
        first = next(line for line in process.stderr if "http" in line)
        base, _, token = next(word for word in first.split() if word.startswith("http")).partition("/#token=")
        assert len(token) >= 32
        answers: list[str] = []
        for key in (token, token[:-1], token + "x"):
            headers = {"X-Micron-Token": key, "Content-Type": "application/json"}
            for path, body in (
                ("/api/channels", None), ("/api/recordings", None),
                ("/api/nothing", None), ("/api/recording/start", b"{"),
                ("/api/safe", b"{}"), ("/api/recording/start", b'{"name": "../x"}'), ("/", None),
            ):  # fmt: skip
                answers.append(ask(base, path, headers, body))
        with connect(base.replace("http", "ws") + "/live", open_timeout=30) as ws:
            for text in (json.dumps({"type": "hello", "token": token}), '{"type": "what"}', "{"):
                ws.send(text)
            for _ in range(3):
                message = ws.recv(30)
                answers.append(message if isinstance(message, str) else message.decode("latin-1"))
        for number in descendants(process.pid):
            for file in ("cmdline", "environ"):
                answers.append(Path(f"/proc/{number}/{file}").read_bytes().decode(errors="replace"))
        assert not any(token in answer for answer in answers)
    finally:
        process.send_signal(signal.SIGTERM)
        stdout, stderr = process.communicate(timeout=60)
    assert stdout == ""
    assert token not in stderr  # what came after the first line
    assert first.count(token) == 1
    assert not any(token.encode() in path.read_bytes() for path in tmp_path.rglob("*") if path.is_file())


def test_a_running_instrument_leaves_it_nowhere(server: Server):
    """Status, requests, logs and metadata of a run, the recorder's and the world's files, environments and arguments of
    all processes."""
    state = server.wait_running()
    token = server.token.encode()
    assert token not in json.dumps(state).encode()
    files = [path for path in server.folder.rglob("*") if path.is_file()]
    assert {"request.json", "metadata.json"} <= {path.name for path in files}
    assert [path for path in files if token in path.read_bytes()] == []
    processes = descendants(server.process.pid)
    assert len(processes) >= 2  # server and firmware at least
    for number in processes:
        for file in ("cmdline", "environ"):
            try:
                assert token not in Path(f"/proc/{number}/{file}").read_bytes()
            except (FileNotFoundError, ProcessLookupError):  # it has ended meanwhile
                continue
