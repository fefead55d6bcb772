"""A compiled run as the bench page makes it: started by a request, recorded, and read by one viewer without drawing."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any
from unittest.mock import patch

from benchmarks.bench_page import CHANNELS, VIEWER, post, record, state
from tools.research.pictures import started

END_S = 60.0
START_S = 120.0


def run_watched(bench: Path, seconds: float, folder: Path) -> tuple[dict[str, Any], float]:
    """Run ``bench`` compiled from the page for ``seconds`` after arming; the outcome, and the viewer's frames a second.

    ``folder`` takes what the page writes. Raises ``RuntimeError`` when the run ends before.
    """
    subscription = json.dumps({"type": "subscribe", "id": 1, "channels": CHANNELS, "rows": 5000, "pixels": 1200})
    options = ("--bench", str(bench), "--recordings", str(folder / "recordings"), "--realtime")
    with patch.dict(os.environ, TMPDIR=str(folder)), started(*options) as (_, address):
        url = address.partition("/#")[0].replace("http", "ws") + "/live"
        post(address, "/api/firmware/start", compiled=True)
        until_s = time.monotonic() + START_S
        while (now := state(url))["status"].get("state") != "running":
            require_run(now)
            if time.monotonic() > until_s:
                raise RuntimeError(f"the compiled run behind the page was not armed within {START_S:g} s")
            time.sleep(0.1)
        record(address)
        command = [sys.executable, "-c", VIEWER, url, str(seconds), subscription]
        viewer = subprocess.run(command, capture_output=True, text=True, check=True)
        require_run(state(url))
        post(address, "/api/safe")
        return await_outcome(folder), int(viewer.stdout) / seconds


def require_run(now: dict[str, Any]) -> None:
    """Raise ``RuntimeError`` unless a compiled run begins or is there."""
    if not now["compiled"] or now["phase"] not in ("starting", "running"):
        raise RuntimeError(f"the compiled run is over, nothing to measure: {now['phase']}, {now['reason']}")


def await_outcome(folder: Path) -> dict[str, Any]:
    """Return the outcome that the page's firmware leaves in its folder below ``folder``."""
    until_s = time.monotonic() + END_S
    while time.monotonic() < until_s:
        for path in folder.glob("micron-bench-*/outcome.json"):
            try:
                return json.loads(path.read_text())
            except ValueError:  # it is being written
                pass
        time.sleep(0.05)
    raise RuntimeError(f"the firmware of the page left no outcome within {END_S:g} s")
