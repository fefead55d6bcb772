"""The page as a person uses it: Chromium against a real server, a real firmware process and the emulated world."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.bench.conftest import Server, go, opened_tab
from tests.bench.test_every_size import VIEWS

pytestmark = pytest.mark.timeout(400)

NEWEST = "(() => { const t = micron.scope.subscription.buckets.times(); return t[t.length - 1]; })()"
PICTURE = "document.querySelector('.plot canvas').toDataURL()"


@pytest.mark.parametrize("theme", ["dark", pytest.param("light", marks=pytest.mark.slow)])
def test_every_view_opens(page: Any, artefacts: Path, theme: str):
    page.evaluate(f"document.documentElement.dataset.theme === '{theme}' || document.getElementById('theme').click()")
    for number, view in enumerate(VIEWS, 1):
        page.keyboard.press(str(number % 10))
        page.wait_for_function(f"document.getElementById('view').dataset.view === '{view}'")
        page.wait_for_function(
            "(v => v.innerText.trim() || v.querySelector('canvas'))(document.getElementById('view'))"
        )
        assert page.locator("#view").inner_text().strip() or page.locator("#view canvas").count()
        assert page.locator("#safe").is_visible()
        overflow = page.evaluate("document.documentElement.scrollWidth - innerWidth")
        assert overflow <= 0, f"{view} is wider than 1280 pixels"
        page.screenshot(path=artefacts / f"{view}-{theme}.png")


def test_live_data_move(page: Any):
    go(page, "scope")
    page.wait_for_function("micron.scope.subscription.buckets.n > 100")
    first, frames = page.evaluate(NEWEST), page.evaluate("micron.link.frames")
    picture = page.evaluate(f"window.before = {PICTURE}")
    assert picture.startswith("data:image/png")
    page.wait_for_function(f"{NEWEST} > {first} + 1.0")
    assert page.evaluate("micron.link.frames") > frames
    page.wait_for_function(f"{PICTURE} !== before")  # data are there before they are drawn


def test_a_spike_of_two_milliseconds_is_seen_at_full_zoom_out(page: Any, server: Server, artefacts: Path):
    go(page, "scope")
    page.evaluate(
        """Object.assign(micron.scope.settings, { channels: ["volts_0"], display: "shared" });
        micron.scope.settings.traces.volts_0 = { coupling: "dc" };
        micron.scope.settings.trigger.on = false;
        micron.scope.changed();
        micron.scope.setWindow(600000)"""
    )
    page.wait_for_function("micron.scope.subscription.buckets.n > 1")
    top = "micron.scope.subscription.buckets.highs(0).reduce((m, v) => Math.max(m, v), -1e9)"
    before = page.evaluate(top)
    # on the screen: pixels of the trace's colour, blue rather than red even where a line covers half of each of two
    # pixels, above everything that it did before
    pixels = f"""(() => {{
        const plot = micron.scope.strips[0].strip.plot, g = plot.ctx;
        const high = plot.valToPos({before} + 0.35, "y", true), low = plot.valToPos({before} + 0.1, "y", true);
        const data = g.getImageData(plot.bbox.left, high, plot.bbox.width, Math.max(1, low - high)).data;
        let n = 0;
        for (let i = 0; i < data.length; i += 4)
            if (data[i + 2] - data[i] > 60 && data[i] < 130 && data[i + 3] > 100) n++;
        return n;
    }})()"""
    assert page.evaluate(pixels) == 0
    server.inject("spike", "0")
    page.wait_for_function(f"{top} > {before} + 0.3")
    page.wait_for_function(f"{pixels} > 3")
    later = page.evaluate(NEWEST) + 1.0
    page.wait_for_function(f"{NEWEST} > {later}")
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    seen = page.evaluate(pixels)
    page.screenshot(path=artefacts / "spike.png")
    assert seen > 3, "the spike went from the screen"


def test_the_safe_button_reaches_the_safe_state(page: Any, server: Server, artefacts: Path):
    page.click("#safe")
    page.wait_for_function("micron.link.state.phase === 'safe'")
    state = server.wait_for(lambda s: s["safe_ms"] is not None, "the time")
    # asked when the server sent the order, reached when the amplifier confirmed neutral: both on the firmware's clock
    print(f"safe state {state['safe_ms']:.1f} ms after the order (goal 100 ms)")
    assert state["reason"] == "stopped by the operator (safe button of the bench page)"
    page.wait_for_selector("#alerts >> text=Safe state, outputs at neutral")
    page.screenshot(path=artefacts / "safe.png")
    page.click("#alerts button")
    server.wait_running()


def test_without_the_token_one_may_look_and_touch_nothing(browser: Any, server: Server):
    server.wait_running()
    ready = "window.micron && micron.link.state"
    with opened_tab(browser, f"{server.base}/#token=wrong", ready) as page:
        page.wait_for_selector("#alerts >> text=View only")
        page.wait_for_selector("#ask-token >> text=does not know the token")
        page.click("#safe")
        page.wait_for_selector("#say >> text=did not reach the bench")
        request = "{method: 'POST', headers: {'X-Micron-Token': 'wrong'}}"
        assert page.evaluate(f"fetch('/api/safe', {request}).then((a) => a.status)") == 403
        now_s = page.evaluate("micron.link.state.status.t_s")
        page.wait_for_function(f"micron.link.state.status.t_s > {now_s} + 0.5")
        assert server.state()["phase"] == "running"


def test_a_recording_survives_a_reload_and_a_closed_browser(page: Any, browser: Any, server: Server):
    go(page, "collect")
    page.fill("input[placeholder^='Name']", "survivor")
    page.fill("input[placeholder='Notes']", "made by a robot")
    page.click("#rec-start")
    page.wait_for_selector("#rec:not([hidden])")
    page.reload()
    page.wait_for_selector("#rec:not([hidden])")
    page.close()
    written = server.state()["recording"]["written"]
    server.wait_for(lambda s: s["recording"]["written"] > written + 500, "more rows")
    code, summary = server.request("POST", "/api/recording/stop", b"{}")
    assert code == 200
    assert summary["ticks"] > 500
    assert summary["dropped"] == 0
    assert summary["problem"] == ""
    listed = server.request("GET", "/api/recordings")[1]["recordings"]
    mine = next(r for r in listed if r["name"] == "survivor")
    assert mine["notes"] == ["made by a robot"]
    look = server.request("GET", "/api/recordings/survivor/look?channels=command_1")[1]
    assert look["channels"] == ["command_1"]
    assert 0 < len(look["t"]) <= summary["ticks"]


def jog_once(page: Any, server: Server) -> bool:
    """Arm, hold a jog button until the output has moved, release it, and see the output rest. Return False when the
    switch lapsed meanwhile: a page that is starved for a second does not renew it."""
    page.wait_for_function("!document.getElementById('arm').disabled")
    if page.locator("#arm").get_attribute("aria-checked") != "true":
        page.click("#arm")
    page.wait_for_function("micron.link.state.status.manual === 'armed'")
    volts, lapsed = "micron.link.state.status.command_V[0]", "micron.link.state.status.manual !== 'armed'"
    rest = page.evaluate(volts)
    button = page.locator("button.jog").nth(1)
    page.wait_for_function(f"!document.querySelectorAll('button.jog')[1].disabled || {lapsed}")
    button.hover()
    page.mouse.down()
    page.wait_for_function(f"{volts} > {rest} + 5 || {lapsed}")
    page.mouse.up()
    seen: list[float] = []

    def rests(state: dict[str, Any]) -> bool:
        """Where it was at the last look, or no longer armed."""
        seen.append(state["status"]["command_V"][0])
        return state["status"]["manual"] != "armed" or (len(seen) > 1 and seen[-1] == seen[-2])

    state = server.wait_for(rests, "rest after the release")
    return state["status"]["manual"] == "armed" and seen[-1] > rest + 5


def test_jog_moves_while_held_and_only_then(page: Any, server: Server):
    go(page, "actuators")
    while not jog_once(page, server):
        continue
    if page.locator("#arm").get_attribute("aria-checked") == "true":
        page.click("#arm")
    server.wait_for(lambda s: s["status"]["manual"] == "off", "the end of manual drive")
    assert server.state()["phase"] == "running"
