"""The loop with the page's link, in virtual time: what the page is shown comes without a single real second."""

from __future__ import annotations

import os
import socket
from typing import Any

from firmware_py.app import run_in_process
from firmware_py.frame import LAYOUT
from firmware_py.live.memory import LiveMemory
from firmware_py.run_request import RunRequest
from tests.conftest import DEFAULT_BENCH


def test_frames_histograms_and_numbers_reach_the_page():
    memory = LiveMemory.create(LAYOUT.size, 8192)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    told: list[dict[str, Any]] = []
    request = RunRequest(DEFAULT_BENCH, 0.5, pace="virtual", live_fds=(os.dup(memory.fd), theirs.detach()))
    try:
        outcome, _ = run_in_process(request, told.append)
        assert outcome["safe_state"]["normal"]
        rows = memory.read(0)
        assert len(rows.values) + rows.missed == outcome["ticks"]["run"] + outcome["ticks"]["caught_up"]
        names = next(t["histograms"] for t in told if t.get("event") == "devices")
        shown = memory.histogram(names.index("actuate"))
        assert shown.n > 100
        numbers = [t for t in told if "tasks" in t]
        assert numbers
        assert numbers[-1]["commands"] > 100
        assert numbers[-1]["manual"] == "off"
    finally:
        memory.close()
        ours.close()
