"""The loop with the page's link, in virtual time: what the page is shown and orders comes without a single real second.

Both loops: the one in Python, and the compiled thread, which takes a minute to compile.
"""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from firmware_py.app import run_in_process
from firmware_py.frame import LAYOUT
from firmware_py.live.memory import LiveMemory
from firmware_py.run_request import RunRequest
from hal.bench import OpenBench
from hal.contracts import Clock
from tests.conftest import DEFAULT_BENCH
from tools.research.faults.carriers import SocketPort

pytestmark = pytest.mark.timeout(900)
NEUTRAL_V = 50.0


@dataclass
class Page:
    """The page's end of the link. ``then`` is called with every status line."""

    is_compiled: bool
    memory: LiveMemory
    control: socket.socket
    theirs: socket.socket
    told: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])
    opened: list[OpenBench] = field(default_factory=list[OpenBench])

    def order(self, **order: Any) -> None:
        self.control.send(json.dumps(order).encode())

    def run(self, seconds: float, then: Callable[[dict[str, Any]], None] = lambda _: None) -> dict[str, Any]:
        """Run the default bench for ``seconds``; its outcome."""

        def tell(status: Any) -> None:
            self.told.append(status)
            then(status)

        fds = os.dup(self.memory.fd), self.theirs.detach()
        request = RunRequest(DEFAULT_BENCH, seconds, pace="virtual", live_fds=fds, compiled=self.is_compiled)
        outcome, _ = run_in_process(request, tell, on_open=self.opened.append, wrap=with_descriptor)
        assert outcome["loop"]["kind"] == ("compiled" if self.is_compiled else "python")
        return outcome


def with_descriptor(_bus: str, port: Any, _clock: Clock) -> Any:
    """The compiled thread reads serial lines from a descriptor."""
    return SocketPort(port) if hasattr(port, "drain_input") else port


@pytest.fixture(params=[False, pytest.param(True, marks=pytest.mark.slow)], ids=["python", "compiled"])
def page(request: pytest.FixtureRequest) -> Iterator[Page]:
    made = Page(request.param, LiveMemory.create(LAYOUT.size, 8192), *socket.socketpair(type=socket.SOCK_SEQPACKET))
    yield made
    made.memory.close()
    made.control.close()
    made.theirs.close()


def is_running(status: dict[str, Any]) -> bool:
    return status.get("state") == "running"


def test_frames_histograms_and_numbers_reach_the_page(page: Page) -> None:
    outcome = page.run(0.5)
    assert outcome["safe_state"]["normal"]
    rows = page.memory.read(0)
    assert len(rows.values) + rows.missed == outcome["ticks"]["run"] + outcome["ticks"]["caught_up"]
    names = next(t["histograms"] for t in page.told if t.get("event") == "devices")
    shown = page.memory.histogram(names.index("actuate"))
    assert shown.n > 100
    numbers = [t for t in page.told if "tasks" in t]
    assert numbers
    assert numbers[-1]["commands"] > 100
    assert numbers[-1]["manual"] == "off"


def test_the_safe_button_takes_the_outputs_to_neutral(page: Page) -> None:
    outcome = page.run(60.0, lambda status: page.order(order="safe") if is_running(status) else None)
    safe = outcome["safe_state"]
    assert (safe["reached"], safe["finding"]) == (True, "stopped_on_page")
    (said,) = (told for told in page.told if told.get("event") == "safe state")
    assert said["reached"]


def test_a_gain_of_the_page_reaches_the_ticks(page: Page) -> None:
    page.run(2.5, lambda status: page.order(order="gain", value=0.0) if is_running(status) else None)
    assert page.told[-2]["gain"] == 0.0
    start = LAYOUT.start("desired_tip")
    wanted_m = page.memory.read(0).values[:, start : start + 3]
    assert np.ptp(wanted_m, axis=0).max() > 1e-6
    assert np.ptp(wanted_m[-100:], axis=0).max() == 0.0, "nothing follows the hand any more"


def test_a_page_that_goes_away_leaves_the_run_as_it_is(page: Page) -> None:
    outcome = page.run(0.5, lambda status: page.control.close() if is_running(status) else None)
    assert outcome["safe_state"]["normal"]


def test_what_goes_wrong_in_telling_the_page_ends_at_neutral(page: Page) -> None:
    def fail(status: dict[str, Any]) -> None:
        if is_running(status):
            raise RuntimeError("the page cannot be told")

    with pytest.raises(RuntimeError, match="cannot be told"):
        page.run(60.0, fail)
    (said,) = (told for told in page.told if told.get("event") == "safe state")
    assert said["reached"]
    world = page.opened[0].world
    assert world is not None
    np.testing.assert_allclose(world.truth()["amplifier_V"][-1], NEUTRAL_V, atol=0.01)
