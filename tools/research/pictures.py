"""``make pictures``: screenshots of every view of a running bench page and of a mismatch report, for the documents.

Needs the package ``playwright`` and Debian's Chromium; starts its own server on a free port.
"""

from __future__ import annotations

import argparse
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hal.children import child_command, child_environment
from tools.terminal import plain_console

VIEWS = ("scope", "attitude", "tremor", "latency", "actuators", "targets", "collect", "mismatch", "calibrate", "setup")
SETTLE_MS = {"scope": 3000, "tremor": 3000}
STEADY_S = 9.0
"""Time of the run at the first picture: the start-up has left every window by then."""


@contextmanager
def started(*options: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Start ``micron bench`` with ``options`` on a free port, and end it with the block. Yield its process and
    the address that it printed, with the token."""
    server = subprocess.Popen(
        child_command("tools.cli.main", "bench", "--port", "0", *options),
        stderr=subprocess.PIPE,
        text=True,
        env={**child_environment(), "COLUMNS": "400"},  # the address in one line
    )
    try:
        assert server.stderr is not None
        address = next(word for line in server.stderr for word in line.split() if word.startswith("http"))
        threading.Thread(target=server.stderr.read, daemon=True).start()
        yield server, address
    finally:
        if server.poll() is None:
            server.send_signal(signal.SIGTERM)
            server.wait(60)


def take(page: Any, folder: Path, views: tuple[str, ...]) -> None:
    """Take a picture per view."""
    page.wait_for_function("micron.link.state.status.state === 'running'", timeout=240_000)
    page.wait_for_function(f"micron.link.state.status.t_s > {STEADY_S}", timeout=240_000)
    # folders are those of the machine that takes the pictures
    page.add_style_tag(content=".list h2 small, .setup h2 small { visibility: hidden }")
    for view in views:
        page.evaluate(f"location.hash = '/{view}'")
        page.wait_for_function(f"document.getElementById('view').dataset.view === '{view}'")
        page.wait_for_timeout(SETTLE_MS.get(view, 3000))
        page.wait_for_function("!document.querySelector('#alerts .error')", timeout=60_000)
        page.screenshot(path=folder / f"{view}.png", timeout=90_000)


def report(folder: Path) -> Path:
    """The report on the recording of docs/tutorial-mismatch.md: an emulated stack against one that only multiplies."""
    lab = ["sim_devices.plant.lab", "piezo", "--profile", "loops", "--seconds", "20", "--out", "lab-stack"]
    diagnose = ["tools.cli.main", "mismatch", "diagnose", "lab-stack", "--html", "report.html"]
    for command in (lab, diagnose):
        subprocess.run([sys.executable, "-m", *command], check=True, stdout=subprocess.DEVNULL, cwd=folder)
    return folder / "report.html"


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tools.research.pictures", description=__doc__)
    parser.add_argument("folder", type=Path, help="folder that takes the pictures")
    folder: Path = parser.parse_args(arguments).folder
    people = plain_console(stderr=True)
    chromium = shutil.which("chromium")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        people.print("the package playwright is missing: pip install playwright")
        return 1
    if chromium is None:
        people.print("no Chromium: apt-get install chromium")
        return 1
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="micron-") as recordings, sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=chromium, args=["--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
        )
        page = browser.new_context(viewport={"width": 1280, "height": 720}, bypass_csp=True).new_page()
        with started("--recordings", recordings) as (_, address):
            page.goto(address)
            page.wait_for_function("window.micron && micron.link.state && micron.link.state.status")
            take(page, folder, VIEWS)
            page.evaluate("location.hash = '/scope'")
            page.keyboard.press("t")
            page.wait_for_timeout(1000)
            page.screenshot(path=folder / "dark.png", timeout=90_000)
            page.goto("about:blank")  # nothing else runs beside the diagnosis
        page.goto(report(Path(recordings)).as_uri())
        page.wait_for_timeout(1000)
        page.screenshot(path=folder / "report.png", timeout=90_000)
        browser.close()
    people.print(f"pictures: {folder}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
