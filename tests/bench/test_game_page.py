"""The targeting experiment on the page, won by a scripted mouse. The game's clock is the test's: how long a button is
held and how far the view has moved do not depend on how busy the machine is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from firmware_py.endoscope.control import INACTIVE, MOVE, ZOOM, ControlConfig
from tests.bench.conftest import go, opened_tab
from tests.bench.still import Still, still_server

pytestmark = pytest.mark.timeout(400)

STEP_S = 0.1
"""Virtual time between two pointer messages: the longest step that the game uses."""
SETTLED_STEPS = 40
"""Steps in which the view has followed the pointer; its filter has 0.25 s."""
ROTATION_DEG = 90.0
"""Pointer angles from the left edge of the screen to the right one."""
COUNT_MESSAGES = """() => {
    const send = micron.link.send.bind(micron.link);
    window.pointers = 0;
    micron.link.send = (message) => { send(message); if (message.type === "pointer") window.pointers += 1; };
}"""


class Clock:
    """Seconds that only the test moves. The game reads it once when it starts and once per pointer message."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.readings = 0

    def read_s(self) -> float:
        """Return the time and count the call."""
        now_s = self.now_s
        self.readings += 1
        return now_s


class Player:
    """A mouse on the screen of one game."""

    def __init__(self, page: Any, still: Still, clock: Clock) -> None:
        self.page, self.still, self.clock = page, still, clock
        box = page.locator("#target-screen").bounding_box()
        self.px_per_deg = box["width"] / ROTATION_DEG
        self.centre = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)

    def state(self) -> dict[str, Any]:
        """The game as the server has it."""
        game = self.still.session.targets.as_dict()
        assert game is not None
        return game

    def take(self) -> dict[str, Any]:
        """Wait until the server has taken every message that the page sent before this call, and one after it."""
        if self.state()["done"]:
            return self.state()
        sent = self.page.evaluate("pointers")
        self.page.wait_for_function(f"pointers > {sent} || micron.game().done")
        while self.clock.readings < sent + 2 and not self.state()["done"]:
            self.page.wait_for_timeout(5)
        return self.state()

    def wait(self, seconds: float) -> dict[str, Any]:
        """Let ``seconds`` of virtual time pass, one message at least per ``STEP_S``."""
        for _ in range(max(1, round(seconds / STEP_S))):
            self.clock.now_s += STEP_S
            self.take()
        return self.state()

    def move_to(self, psi_deg: float, theta_deg: float) -> None:
        """Point there; the server knows when this returns."""
        x, y = self.centre[0] + psi_deg * self.px_per_deg, self.centre[1] + theta_deg * self.px_per_deg
        self.page.mouse.move(x, y)
        self.take()

    def press(self, seconds: float) -> dict[str, Any]:
        """Hold the button; the pointer counts again when this returns."""
        self.page.mouse.down()
        self.take()
        self.wait(seconds)
        self.page.mouse.up()
        self.take()
        return self.wait(STEP_S)

    def drag(self, psi_deg: float, theta_deg: float, hold_s: float, status: int) -> None:
        """Press, turn by these angles, wait until the view rests or the next target is there, and press again."""
        reached = self.state()["reached"]
        self.move_to(-psi_deg / 2, -theta_deg / 2)
        assert self.press(hold_s)["status"] == status
        self.move_to(psi_deg / 2, theta_deg / 2)
        for _ in range(SETTLED_STEPS):
            if self.wait(STEP_S)["reached"] > reached:
                break
        if not self.state()["done"]:
            assert self.press(STEP_S)["status"] == INACTIVE


def test_the_game_is_won_with_a_scripted_mouse(browser: Any, tmp_path: Path, artefacts: Path):
    clock, recordings = Clock(), tmp_path / "recordings"
    with (
        still_server(recordings, read_clock_s=clock.read_s) as still,
        opened_tab(browser, still.address) as page,
    ):
        page.evaluate(COUNT_MESSAGES)
        page.evaluate("micron.seed = 7")
        go(page, "targets")
        page.fill("input[placeholder='Your name']", "robot")
        page.click("#target-start")
        page.wait_for_function("micron.game() && micron.game().of === 5 && !micron.game().done")
        player = Player(page, still, clock)
        gain = ControlConfig().gain
        for number in range(5):
            now = player.state()
            assert now["reached"] == number, now
            player.drag((now["target"]["size"] - now["view"]["size"]) / gain, 0.0, 0.7, ZOOM)
            now = player.state()
            psi, theta = ((now["target"][axis] - now["view"][axis]) / gain for axis in "xy")
            player.drag(psi, theta, STEP_S, MOVE)
        page.wait_for_function("micron.game().report")
        page.screenshot(path=artefacts / "game.png")
        final = page.evaluate("micron.game()")
    assert final["result"]["reached"] == 5
    assert final["elapsed_s"] == pytest.approx(player.state()["elapsed_s"])
    report = (recordings / "targets" / final["report"]).read_text()
    assert report.startswith("# user robot\n")
    assert len([line for line in report.splitlines() if line[0].isdigit()]) == 5
