"""The page at every size: the safe button is in reach, nothing scrolls sideways, charts keep their shape, and text can
be read. One browser, one server in this process over data that stand still (tests/bench/still.py)."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from tests.bench.conftest import go, opened_tab
from tests.bench.still import Still

pytestmark = pytest.mark.timeout(400)

VIEWS = ("scope", "attitude", "tremor", "latency", "actuators", "targets", "collect", "mismatch", "calibrate", "setup")
THEMES = ("dark", "light")


def combinations(sizes: Iterable[str], *default: tuple[str, str]) -> list[Any]:
    """Every size in every theme; those that are not in ``default`` run with the slow tests."""
    every = [(size, theme) for size in sizes for theme in THEMES]
    return [pytest.param(*pair, marks=() if pair in default else pytest.mark.slow) for pair in every]


SIZES = {  # name: CSS width and height, device pixels per CSS pixel
    "320": (320, 640, 1.0),
    "390": (390, 844, 1.0),
    "768": (768, 1024, 1.0),
    "1024": (1024, 768, 1.0),
    "1280": (1280, 720, 1.0),
    "1920": (1920, 1080, 1.0),
    # a browser that zooms gives the page a smaller window with more pixels in each of its own
    "1280 at 200 %": (640, 360, 2.0),
    "1280 at 400 %": (320, 180, 4.0),
}
READY = {  # what is there when the view's first answers have come
    "scope": ".plot canvas",
    "attitude": "table td",
    "tremor": "table td",
    "latency": "tbody tr",
    "actuators": ".big .unit",
    "targets": "canvas",
    "collect": "tbody button",
    "mismatch": "select option",
    "calibrate": ".warm b:not(:empty)",
    "setup": "datalist option",
}
READ = ("390", "1280")
"""Sizes at which the texts are looked at as well: below and above the width at which tables become cards."""
AS_MENU = ("320", "390", "1280 at 200 %", "1280 at 400 %")
"""Sizes at which the views are behind a button; the others show all of them."""
SAFE_PX = 44
CONTRAST = 4.5

MEASURE = """() => {
    const safe = document.getElementById("safe").getBoundingClientRect();
    const middle = document.elementFromPoint(safe.x + safe.width / 2, safe.y + safe.height / 2);
    const view = document.getElementById("view");
    const charts = [...view.querySelectorAll("canvas.draw, .plot-body")].filter((e) => e.offsetParent).map((e) => {
        const box = e.getBoundingClientRect();
        const inner = e.tagName === "CANVAS" ? e : e.querySelector("canvas");
        const drawn = inner.getBoundingClientRect();
        return { width: box.width, height: box.height, small: Boolean(e.closest("td")),
                 stretch: (inner.width / inner.height) / (drawn.width / drawn.height) };
    });
    return { x: safe.x, y: safe.y, width: safe.width, height: safe.height,
             hit: Boolean(middle && middle.closest("#safe")),
             page: document.documentElement.scrollWidth, view: view.scrollWidth - view.clientWidth,
             tall: document.documentElement.scrollHeight,
             w: innerWidth, h: innerHeight, charts };
}"""


@contextmanager
def opened(browser: Any, still: Still, size: str, theme: str = "dark", **more: Any) -> Iterator[Any]:
    """A page with the token; an error in the page fails the test."""
    width, height, ratio = SIZES[size]
    window = {"viewport": {"width": width, "height": height}, "device_scale_factor": ratio, "color_scheme": theme}
    with opened_tab(browser, still.address, reduced_motion="reduce", **window, **more) as tab:
        yield tab


def show(tab: Any, view: str) -> None:
    """To ``view``, until its charts have been drawn and its lists have come."""
    go(tab, view)
    tab.wait_for_selector(f"#view {READY[view]}", state="attached")
    tab.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")


@pytest.mark.parametrize(
    ("size", "theme"),
    combinations(SIZES, ("390", "dark"), ("768", "dark"), ("1280", "light"), ("1280 at 400 %", "light")),
)
def test_every_view_is_safe_readable_and_in_shape(browser: Any, still: Still, size: str, theme: str):
    """The safe button is in reach, nothing scrolls sideways, charts keep their shape; at ``READ`` sizes every text
    stands out from what is behind it, axe finds nothing serious and fingers find what they touch."""
    with opened(browser, still, size, theme, has_touch=size == "390") as tab:
        axe = load_axe(tab) if size in READ else None
        as_menu = size in AS_MENU
        assert tab.locator("#menu").is_visible() == as_menu
        assert all(link.is_visible() != as_menu for link in tab.locator("#nav a").all())
        for view in VIEWS:
            show(tab, view)
            for where in ("0", "document.getElementById('view').scrollHeight"):
                tab.evaluate(f"document.getElementById('view').scrollTop = {where}")
                check_frame(tab.evaluate(MEASURE), view, size)
            if size == "390":
                check_fingers(tab, view)
            if size in READ:
                texts = tab.evaluate(COLOURS)
                assert len(texts) > 15, view
                assert [text for text in texts if text[0] < CONTRAST] == [], view
                check_axe(tab, view)
    if size in READ and not axe:
        pytest.skip("all but axe-core was looked at: it is not installed; 'make setup' does it")


def check_frame(seen: dict[str, Any], view: str, size: str) -> None:
    told = f"{view}: {seen}"
    assert seen["height"] >= SAFE_PX, told
    assert seen["width"] >= SAFE_PX, told
    assert 0 <= seen["x"] <= seen["w"] - seen["width"], told
    assert 0 <= seen["y"] <= seen["h"] - seen["height"], told
    assert seen["hit"], f"something covers the button: {told}"
    assert seen["page"] <= seen["w"], told
    assert seen["view"] <= 0, told
    assert seen["tall"] <= seen["h"], told
    check_charts(seen["charts"], view, size)


def check_charts(charts: list[dict[str, Any]], view: str, size: str) -> None:
    """Pixels are as wide as high; where the view scrolls, a chart has its own shape, else room that is worth it."""
    width, height, _ = SIZES[size]
    fixed_frame = width >= 1100 and height >= 560
    for chart in charts:
        told = f"{view}: {chart}"
        assert chart["stretch"] == pytest.approx(1.0, abs=0.03), told
        if chart["small"]:  # a histogram in a row of a table
            continue
        if fixed_frame:
            assert chart["height"] >= 40, told
        else:
            assert chart["height"] >= 85, told
            assert 0.95 <= chart["width"] / chart["height"] <= 3.2, told


def test_an_order_reaches_the_server_from_the_smallest_window(browser: Any, still: Still):
    still.session.orders.clear()
    with opened(browser, still, "1280 at 400 %", has_touch=True) as tab:
        show(tab, "latency")
        tab.locator("#safe").tap()
        with tab.expect_response("**/api/safe"):
            tab.locator("#safe").tap()
    assert still.session.orders
    assert set(still.session.orders) == {"safe"}


@pytest.mark.parametrize("size", ["390", "1280 at 400 %"])
def test_the_menu_opens_goes_to_a_view_and_closes(browser: Any, still: Still, size: str):
    with opened(browser, still, size, has_touch=True) as tab:
        assert not tab.locator("#nav").is_visible()
        tab.locator("#menu").tap()
        assert tab.locator("#menu").get_attribute("aria-expanded") == "true"
        for link in tab.locator("#nav a").all():
            link.scroll_into_view_if_needed()
            box = link.bounding_box()
            assert box is not None
            assert box["height"] >= SAFE_PX
        assert tab.evaluate(MEASURE)["hit"], "the menu covers the safe button"
        tab.locator("#nav a[data-view=tremor]").tap()
        tab.wait_for_function("document.getElementById('view').dataset.view === 'tremor'")
        assert not tab.locator("#nav").is_visible()


def test_two_fingers_that_enlarge_the_page_take_the_button_with_them(browser: Any, still: Still):
    with opened(browser, still, "390", has_touch=True, is_mobile=True) as tab:
        show(tab, "tremor")
        assert not tab.locator("#safe-near").is_visible()
        tab.context.new_cdp_session(tab).send("Emulation.setPageScaleFactor", {"pageScaleFactor": 4})
        tab.wait_for_function("visualViewport.scale > 3.9")
        tab.wait_for_selector("#safe-near", state="visible")
        inside, height = tab.evaluate(
            """() => {
                const box = document.getElementById("safe-near").getBoundingClientRect(), v = visualViewport;
                return [box.left >= v.offsetLeft && box.right <= v.offsetLeft + v.width + 0.5
                        && box.top >= v.offsetTop && box.bottom <= v.offsetTop + v.height + 0.5,
                        box.height * v.scale];
            }"""
        )
        assert inside
        assert height >= SAFE_PX - 0.5


def check_fingers(tab: Any, view: str) -> None:
    assert tab.evaluate("matchMedia('(pointer: coarse)').matches")
    small = tab.evaluate(
        """() => [...document.querySelectorAll("button, select, summary, #nav a, input:not([type=checkbox])")]
            .filter((e) => e.offsetParent && e.getBoundingClientRect().height < 43.5)
            .map((e) => e.outerHTML.slice(0, 100))"""
    )
    assert [entry for entry in small if 'id="log-toggle"' not in entry] == [], view


COLOURS = """() => {
    // the colour behind an element: its own background over those of its ancestors
    const canvas = document.createElement("canvas");
    canvas.width = canvas.height = 1;
    const g = canvas.getContext("2d", { willReadFrequently: true });
    const paint = (layers) => {
        g.clearRect(0, 0, 1, 1);
        for (const layer of layers) { g.fillStyle = layer; g.fillRect(0, 0, 1, 1); }
        return [...g.getImageData(0, 0, 1, 1).data.slice(0, 3)];
    };
    const linear = (v) => (v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
    const light = (rgb) => {
        const [r, gr, b] = rgb.map((v) => linear(v / 255));
        return 0.2126 * r + 0.7152 * gr + 0.0722 * b;
    };
    const found = [];
    const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    for (let node = walk.nextNode(); node; node = walk.nextNode()) {
        const element = node.parentElement;
        if (!node.data.trim() || !element.checkVisibility({ checkOpacity: true, checkVisibilityCSS: true })) continue;
        if (element.closest("option, iframe, script, style") || element.closest(":disabled")) continue;
        const layers = [];
        for (let e = element; e; e = e.parentElement) layers.unshift(getComputedStyle(e).backgroundColor);
        const behind = paint(layers);
        const front = paint([...layers, getComputedStyle(element).color]);
        const [a, b] = [light(behind), light(front)].sort((p, q) => q - p);
        found.push([(a + 0.05) / (b + 0.05), node.data.trim().slice(0, 40), element.tagName, element.className]);
    }
    for (const element of document.querySelectorAll("input[placeholder]")) {
        if (!element.checkVisibility()) continue;
        const layers = [];
        for (let e = element; e; e = e.parentElement) layers.unshift(getComputedStyle(e).backgroundColor);
        const [behind, front] = [paint(layers), paint([...layers, getComputedStyle(element, "::placeholder").color])];
        const [a, b] = [light(behind), light(front)].sort((p, q) => q - p);
        found.push([(a + 0.05) / (b + 0.05), element.placeholder, "placeholder", ""]);
    }
    // labels inside charts are drawn in these colours, on a panel
    for (const name of ["--faint", "--soft"]) {
        const style = getComputedStyle(document.documentElement);
        const [p, q] = ["--panel", name].map((colour) => light(paint([style.getPropertyValue(colour)])));
        const [a, b] = [p, q].sort((x, y) => y - x);
        found.push([(a + 0.05) / (b + 0.05), name, "chart", ""]);
    }
    return found;
}"""


def load_axe(tab: Any) -> bool:
    """Put axe-core into the page. Return False where it is not installed."""
    try:
        from axe_playwright_python import base
    except ImportError:
        return False
    tab.evaluate(base.AXE_SCRIPT)
    return True


def check_axe(tab: Any, view: str) -> None:
    result = tab.evaluate("window.axe ? axe.run(document, { resultTypes: ['violations'] }) : { violations: [] }")
    grave = [
        (v["id"], v["impact"], [node["html"][:120] for node in v["nodes"][:4]])
        for v in result["violations"]
        if v["impact"] in ("serious", "critical")
    ]
    assert grave == [], f"{view}: {json.dumps(grave, indent=1)}"
