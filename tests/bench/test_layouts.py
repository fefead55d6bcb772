"""Layouts of the page: saved with the bench, shared as a file, back after a reload; a page that outlives its server.

Over data that stand still (tests/bench/still.py): no firmware, no real time.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.bench.conftest import go, opened_tab
from tests.bench.still import Still, still_server
from tools.bench.layouts import KIND, Layouts
from tools.errors import InputError

pytestmark = pytest.mark.timeout(400)

GOOD: dict[str, Any] = {"kind": KIND, "format": 1, "view": "scope", "settings": {"tremor": {"plane": "xz"}}}
READY = "window.micron && micron.scope && micron.scope.traces.length && micron.link.mayOrder"


@contextmanager
def opened(browser: Any, still: Still) -> Iterator[Any]:
    with opened_tab(browser, still.address, READY) as tab:
        yield tab


def names(tab: Any) -> list[str]:
    return tab.evaluate("micron.scope.traces.map((t) => t.name)")


def use(tab: Any, **settings: Any) -> None:
    tab.evaluate("(s) => { Object.assign(micron.scope.settings, s); micron.scope.changed(); }", settings)


def test_a_layout_is_saved_with_the_bench_and_loaded_again(browser: Any, still: Still):
    with opened(browser, still) as tab:
        use(tab, channels=["volts_3", "rate_x"], rows=5000)
        tab.click("#nav button")
        tab.fill("input[aria-label='Name of the layout']", "inputs, wiring")
        tab.click("#layouts button:has-text('Save')")
        tab.wait_for_selector("#layouts .use:has-text('inputs, wiring')")
        assert "In use: inputs, wiring." in tab.locator("#layouts").inner_text()
        kept = still.session.layouts.path("inputs, wiring")
        assert json.loads(kept.read_text())["settings"]["scope.2"]["channels"] == ["volts_3", "rate_x"]
    with opened(browser, still) as tab:  # somebody else, in a browser that was never here
        assert "volts_3" not in names(tab)
        go(tab, "tremor")
        tab.click("#nav button")
        tab.click("#layouts .use:has-text('inputs, wiring')")
        tab.wait_for_function("document.getElementById('view').dataset.view === 'scope'")
        tab.wait_for_function("micron.scope.settings.rows === 5000")
        assert names(tab) == ["rate_x", "volts_3"] or names(tab) == ["volts_3", "rate_x"]
        use(tab, channels=["volts_3"])
        tab.click("#nav button")
        tab.click("#nav button")
        assert "In use: inputs, wiring, changed since." in tab.locator("#layouts").inner_text()
        tab.click("#nav a[data-view=setup]")
        tab.wait_for_function("document.getElementById('view').dataset.view === 'setup'")
        assert not tab.locator("#layouts").is_visible(), "it does not lie over the view that was gone to"
        tab.click("#nav a[data-view=scope]")
        tab.reload()
        tab.wait_for_function(READY)
        assert names(tab) == ["volts_3"], "the last one comes back as it was left"
        assert tab.locator("#safe").is_visible()


def test_a_layout_goes_to_a_file_and_comes_from_one(browser: Any, still: Still, tmp_path: Path):
    with opened(browser, still) as tab:
        use(tab, channels=["temperature"])
        tab.click("#nav button")
        with tab.expect_download() as download:
            tab.click("text=To a file")
        download.value.save_as(tmp_path / "mine.layout.json")
    with opened(browser, still) as tab:
        tab.click("#nav button")
        tab.set_input_files("input[aria-label='Layout file']", tmp_path / "mine.layout.json")
        tab.wait_for_function("micron.scope.traces.map((t) => t.name).join() === 'temperature'")
        before = tab.evaluate("JSON.stringify(micron.scope.settings)")
        for name, content, said in (
            ("no.json", "{", "is not JSON"),
            ("other.json", '{"a": 1}', "not a layout"),
            ("later.json", json.dumps({**GOOD, "format": 9}), "format 9"),
        ):
            (tmp_path / name).write_text(content)
            tab.set_input_files("input[aria-label='Layout file']", tmp_path / name)
            tab.wait_for_function(f"document.querySelector('#layouts [role=alert]').textContent.includes('{said}')")
            assert tab.evaluate("JSON.stringify(micron.scope.settings)") == before


def test_a_layout_of_a_stranger_breaks_nothing(browser: Any, still: Still, tmp_path: Path):
    wrong = {
        "channels": ["volts_1", "of another bench", 7], "rows": "many", "mode": {}, "maths": [{"op": "constructor"}, 3],
        "traces": {"volts_1": {"filter": "constructor", "div": -1, "offset": "1", "coupling": None}, "x": 4},
        "trigger": {"on": True, "channel": "<img>", "level": "high"}, "top": None, "side": "yes",
    }  # fmt: skip
    layout = {
        **GOOD,
        "view": "nowhere",
        "settings": {"scope.2": wrong, "actuators": {"rate": 1e9}, "tremor": {"plane": 3}},
    }
    (tmp_path / "wrong.json").write_text(json.dumps(layout))
    with opened(browser, still) as tab:
        tab.click("#nav button")
        tab.set_input_files("input[aria-label='Layout file']", tmp_path / "wrong.json")
        tab.wait_for_function("micron.scope.traces.map((t) => t.name).join() === 'volts_1'")
        assert "of another bench" in tab.locator(".trigger").inner_text()
        assert tab.evaluate("micron.scope.settings.rows") == 2000
        assert tab.evaluate("micron.scope.traces[0].set").items() >= {"filter": "none", "offset": "1"}.items()
        go(tab, "actuators")
        assert tab.locator("[aria-label='Jog speed'] [aria-pressed=true]").inner_text() == "20"
        go(tab, "tremor")
        tab.wait_for_selector("table td")


@pytest.mark.parametrize("name", ["", "..", "a/b", "a\\b", ".hidden", "x" * 81, "a\nb"])
def test_a_name_that_is_no_file_name_is_refused(tmp_path: Path, name: str):
    with pytest.raises(InputError, match="not a name for a layout"):
        Layouts(tmp_path / "layouts").save(name, GOOD)
    assert not (tmp_path / "layouts").exists()


@pytest.mark.parametrize(
    "layout", [None, [], {}, {**GOOD, "kind": "x"}, {**GOOD, "format": 2}, {**GOOD, "settings": {"tremor": 3}}]
)
def test_what_is_no_layout_is_not_saved(tmp_path: Path, layout: Any):
    with pytest.raises(InputError, match="layout"):
        Layouts(tmp_path).save("mine", layout)
    assert list(tmp_path.iterdir()) == []


def test_links_are_neither_read_nor_written(tmp_path: Path):
    kept, elsewhere = Layouts(tmp_path / "layouts"), tmp_path / "secret"
    kept.save("mine", GOOD)
    elsewhere.write_text(json.dumps(GOOD))
    kept.path("link").symlink_to(elsewhere)
    assert kept.list() == ["mine"]
    for act in (kept.read, kept.delete, lambda name: kept.save(name, GOOD)):
        with pytest.raises(InputError):
            act("link")
    assert kept.read("mine") == GOOD
    assert elsewhere.exists()


@pytest.mark.parametrize("open_reading", [True, False], ids=["loopback", "listen"])
def test_an_open_page_outlives_its_server_and_asks_for_the_new_token(browser: Any, tmp_path: Path, open_reading: bool):
    with still_server(tmp_path / "recordings", open_reading=open_reading) as first:
        port = int(first.base.rpartition(":")[2])
        context = browser.new_context(viewport={"width": 1280, "height": 720}, bypass_csp=True)
        tab = context.new_page()
        tab.goto(first.address)
        tab.wait_for_function(READY)
        use(tab, channels=["volts_1", "volts_2"], trigger={"on": False, "channel": "volts_1", "level": 0})
        tab.wait_for_function("micron.scope.subscription.buckets.n > 100")
        tab.evaluate("micron.scope.setCursor(-1.0, false)")
        assert not tab.locator("#ask-token").is_visible()
    tab.wait_for_function("!micron.link.connected")
    with still_server(tmp_path / "recordings", open_reading=open_reading, token="another", port=port) as second:
        tab.wait_for_selector("#ask-token", state="visible")
        assert "has a new token" in tab.locator("#ask-token").inner_text()
        if open_reading:  # looking is free: it goes on before anybody has typed anything
            tab.wait_for_function("micron.link.connected && micron.scope.subscription.buckets.n > 100")
        tab.fill("#token", "not this one")
        tab.click("#ask-token button")
        tab.wait_for_function("micron.link.token === 'not this one'")
        tab.wait_for_function(
            "micron.link.connected"
        )  # --listen: the server still waits for a token on this connection
        assert tab.locator("#ask-token").is_visible()
        tab.fill("#token", second.address)
        tab.click("#ask-token button")
        tab.wait_for_function("micron.link.mayOrder && micron.scope.subscription.buckets.n > 100")
        tab.wait_for_selector("#ask-token", state="hidden")
        assert names(tab) == ["volts_1", "volts_2"]
        assert tab.evaluate("micron.scope.cursors[0]") == -1.0
        with tab.expect_response("**/api/safe") as answer:
            tab.click("#safe")
        assert answer.value.ok
        assert "safe" in second.session.orders
    context.close()
