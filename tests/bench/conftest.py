"""A bench server of its own for the tests of the page, and a browser to look at it.

Chromium is Debian's; it is installed here where that is possible, else the browser tests are skipped and say why.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.bench.still import Still, still_server
from tests.conftest import DEFAULT_BENCH, copy_of_default_bench

START_S = 220.0
"""Longest wait for anything. It ends a test that hangs; no test is about how long something takes."""
ARTEFACTS = Path(__file__).parents[2] / "out" / "browser"


@dataclass
class Server:
    """A running ``micron bench``."""

    process: subprocess.Popen[str]
    base: str
    token: str
    recordings: Path
    folder: Path

    def request(self, method: str, path: str, body: bytes | None = None, token: str | None = "") -> tuple[int, Any]:
        """Status and JSON; ``token`` "" is the right one, None sends none."""
        headers = {"Content-Type": "application/json"}
        if token is not None:
            headers["X-Micron-Token"] = token or self.token
        asked = urllib.request.Request(self.base + path, body, headers, method=method)
        try:
            with urllib.request.urlopen(asked, timeout=30) as answer:
                return answer.status, json.loads(answer.read() or b"null")
        except urllib.error.HTTPError as error:
            with error:
                return error.code, json.loads(error.read() or b"null")

    @property
    def live(self) -> str:
        return self.base.replace("http", "ws") + "/live"

    def states(self) -> Generator[dict[str, Any], None, None]:
        """Status messages as a page gets them, ten a second."""
        from websockets.sync.client import connect

        with connect(self.live, open_timeout=30) as ws:
            while True:
                message = ws.recv(30)
                if isinstance(message, str) and (table := json.loads(message))["type"] == "state":
                    yield table

    def state(self) -> dict[str, Any]:
        """The next status message."""
        with closing(self.states()) as states:
            return next(states)

    def wait_for(self, good: Callable[[dict[str, Any]], bool], what: str, limit_s: float = START_S) -> dict[str, Any]:
        """The first status for which ``good`` holds."""
        deadline_s = time.monotonic() + limit_s
        with closing(self.states()) as states:
            for state in states:
                if good(state):
                    return state
                if time.monotonic() > deadline_s:
                    pytest.fail(f"{what} did not come within {limit_s:.0f} s: {state['phase']}: {state['reason']}")
        raise AssertionError("status messages end with the connection, by an error")

    def wait_running(self) -> dict[str, Any]:
        """Start the firmware unless it runs; wait until it is armed."""
        state = self.state()
        if state["phase"] not in ("starting", "running"):
            assert self.request("POST", "/api/firmware/start", b"{}")[0] == 200
        return self.wait_for(
            lambda s: s["phase"] == "running" and s["status"].get("state") == "running", "running", START_S
        )

    def inject(self, fault: str, target: str) -> None:
        """A fault in the emulated world of the firmware's process."""
        sockets = sorted(self.folder.glob("micron-bench-*/control.sock"), key=lambda p: p.stat().st_mtime)
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock:
            sock.connect(str(sockets[-1]))
            sock.sendall(json.dumps({"fault": fault, "target": target}).encode() + b"\n")
            assert json.loads(sock.makefile().readline())["ok"]

    def memory_bytes(self) -> int:
        """Resident memory of the server process."""
        pages = int(Path(f"/proc/{self.process.pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE")


@contextmanager
def bench_server(more_toml: str = "", name: str = "bench", options: Sequence[str] = ()) -> Iterator[Server]:
    """``micron bench`` on ``bench`` (the default one and ``more_toml``) or ``endoscope``, in paced emulated time.

    Its files are in a short path, for Unix sockets.
    """
    folder = Path(tempfile.mkdtemp(prefix="mb", dir="/tmp"))
    recordings = folder / "recordings"
    copy_of_default_bench(folder, more_toml)
    shutil.copy(DEFAULT_BENCH.with_name("endoscope.toml"), folder)
    bench = folder / f"{name}.toml"
    command = [sys.executable, "-m", "tools.cli.main", "bench", "--port", "0"]
    command += ["--bench", str(bench), *options]
    process = subprocess.Popen(
        [*command, "--recordings", str(recordings)],
        stdin=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "TMPDIR": str(folder), "COLUMNS": "400"},
    )
    assert process.stderr is not None
    line = next(line for line in process.stderr if "http" in line)
    rest = threading.Thread(target=process.stderr.read, daemon=True)
    rest.start()
    address = next(word for word in line.split() if word.startswith("http"))
    base, _, token = address.partition("/#token=")
    running = Server(process, base, token, recordings, folder)
    try:
        running.wait_running()
        yield running
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(40)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        rest.join()
        process.stderr.close()
        shutil.rmtree(folder, ignore_errors=True)


SERVED = pytest.StashKey["Server"]()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests of the one server follow one another: its firmware starts once for them."""
    items.sort(key=uses_server, reverse=True)


def uses_server(item: pytest.Item) -> bool:
    return "session_server" in getattr(item, "fixturenames", ())


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    """No firmware takes time from tests that need none."""
    running = item.session.stash.get(SERVED, None)
    if running is not None and uses_server(item) and nextitem is not None and not uses_server(nextitem):
        assert running.request("POST", "/api/safe", b"{}")[0] == 200
        running.wait_for(lambda s: s["phase"] not in ("starting", "running"), "the safe state", START_S)


@pytest.fixture(scope="session")
def session_server(request: pytest.FixtureRequest) -> Iterator[Server]:
    """One server for all tests of a session."""
    # the injected spike is to be seen, not to end the run: a sensor that jumps trips the firmware
    with bench_server("\n[firmware.plausibility]\njump_V = 2.0\n") as running:
        request.session.stash[SERVED] = running
        yield running
        del request.session.stash[SERVED]


@pytest.fixture
def server(session_server: Server) -> Server:
    """The session's server with a running firmware."""
    session_server.wait_running()
    return session_server


def go(page: Any, view: str) -> None:
    """To a view of the page; returns when it is there."""
    page.evaluate(f"location.hash = '/{view}'")
    page.wait_for_function(f"document.getElementById('view').dataset.view === '{view}'")


def find_chromium() -> str | None:
    """Path of Debian's Chromium, installed if need be."""
    found = shutil.which("chromium")
    if found is None and shutil.which("apt-get") and os.geteuid() == 0:
        with suppress(subprocess.TimeoutExpired):  # no network: skipped, and said so
            for command in (["apt-get", "update"], ["apt-get", "install", "-y", "--no-install-recommends", "chromium"]):
                subprocess.run(command, capture_output=True, timeout=200, check=False)
        found = shutil.which("chromium")
    return found


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """Chromium without a window."""
    sync_api = pytest.importorskip(
        "playwright.sync_api", reason="the package playwright is not installed; 'make setup' does it"
    )
    path = find_chromium()
    if path is None:
        pytest.skip("no Chromium and none to be had: run 'apt-get install chromium' as root for the browser tests")
    with sync_api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(
            executable_path=path, args=["--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
        )
        yield chromium
        chromium.close()


READY = "window.micron && micron.link.state && micron.link.mayOrder"


@contextmanager
def opened_tab(browser: Any, address: str, ready: str = READY, **more: Any) -> Iterator[Any]:
    """A page of its own, 1280 x 720 and dark unless ``more`` says otherwise; an error in the page fails the test."""
    window = {"viewport": {"width": 1280, "height": 720}, "color_scheme": "dark", "bypass_csp": True}
    context = browser.new_context(**(window | more))
    context.set_default_timeout(1000 * START_S)
    tab = context.new_page()
    tab.errors = errors = []
    tab.on("pageerror", lambda error: errors.append(f"{error} {error.stack}"))
    try:
        tab.goto(address)
        tab.wait_for_function(ready)
        yield tab
    finally:
        context.close()
    assert not errors


@contextmanager
def opened_page(browser: Any, server: Server) -> Iterator[Any]:
    """The bench page of a running firmware, with the token."""
    server.wait_running()
    with opened_tab(browser, f"{server.base}/#token={server.token}") as tab:
        try:
            yield tab
        except BaseException as error:
            state = server.state()
            error.add_note(f"firmware: {state['phase']}, {state['reason']!r}; recording {state['recording']}")
            raise


@pytest.fixture(scope="module")
def still(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Still]:
    """A server over data that stand still, one for the tests of a module."""
    with still_server(tmp_path_factory.mktemp("still") / "recordings") as served:
        yield served


@pytest.fixture(scope="module")
def still_tab(browser: Any, still: Still) -> Iterator[Any]:
    """One page of the module's still server, with the token: a page of its own per test costs a second of CPU."""
    with opened_tab(browser, still.address, SCOPE_READY) as tab:
        yield tab


SCOPE_READY = f"{READY} && micron.scope && micron.scope.traces.length"
FRESH = """() => {
    for (const key of Object.keys(localStorage)) if (key !== "micron.token") localStorage.removeItem(key);
    if (micron.link.replay) micron.link.replayTo({ close: true });
    delete micron.scope;
    micron.context.say("");
    micron.context.reload("scope");
}"""


@pytest.fixture
def still_page(still_tab: Any) -> Iterator[Any]:
    """The module's page as it opens for somebody who was never there: live, on the scope, without settings."""
    still_tab.evaluate(FRESH)
    still_tab.wait_for_function(f"{SCOPE_READY} && !micron.link.replay")
    yield still_tab
    still_tab.unroute_all()
    assert not still_tab.errors


@pytest.fixture
def page(browser: Any, server: Server) -> Iterator[Any]:
    """The page of the session's server."""
    with opened_page(browser, server) as tab:
        yield tab


@pytest.fixture
def artefacts() -> Path:
    """Where screenshots are kept."""
    ARTEFACTS.mkdir(parents=True, exist_ok=True)
    return ARTEFACTS
