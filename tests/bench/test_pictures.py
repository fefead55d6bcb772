"""Pictures of every view beside stored ones, over data that stand still (tests/bench/still.py).

A picture is compared as blocks of 8 x 8 pixels in grey, so that the smoothing of letters and lines does not count and
what moves, vanishes or changes its size does. Letters of another width move everything after them: on a machine with
other fonts the comparison is skipped and says so. ``MICRON_STORE_PICTURES=1`` stores what is drawn now; look at the
pictures before you commit them.
"""

from __future__ import annotations

import io
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from tests.bench.conftest import ARTEFACTS
from tests.bench.still import Still
from tests.bench.test_every_size import READY, VIEWS, show

# other builds of Chromium write dates and break lines otherwise: for the machine that stored the pictures
pytestmark = [pytest.mark.slow, pytest.mark.timeout(400)]

STORED = Path(__file__).with_name("pictures")
FONTS = STORED / "fonts.json"
BLOCK_PX = 8
DIFFERENT = 24
"""Difference of a block's mean grey, of 255, from which on the block is another one."""
MOST_BLOCKS = 0.005
"""Share of blocks that may be different."""
MOST_MEAN = 1.0
"""Mean difference of grey, of 255, over the whole picture."""
FRAMES = {"phone": (390, 844, "light"), "desk": (1280, 720, "dark")}
STEADY = {  # what is awaited besides the first answers: drawn a few times a second, or after a while
    "tremor": "document.querySelector('.tremor .big').textContent !== ''",
    "calibrate": "document.querySelector('.poses').innerText.includes('1 of 14')",
    "latency": "document.querySelector('.budget span')?.textContent",
}
SCOPE = {"trigger": {"on": True, "channel": "tip_displacement_x", "level": 0, "slope": "up", "mode": "normal"}}
WIDTHS = """() => ["--sans", "--mono"].flatMap((font) => [400, 600].map((weight) => {
    const g = document.createElement("canvas").getContext("2d");
    g.font = `${weight} 100px ${getComputedStyle(document.documentElement).getPropertyValue(font)}`;
    return Math.round(g.measureText("Safe state 0123456789 µm/div, sample to command").width);
}))"""


def blocks_of(png: bytes) -> NDArray[np.float64]:
    """Mean grey of every block, 0 to 255; rows and columns that fill no block are left out."""
    grey = np.asarray(Image.open(io.BytesIO(png)).convert("L"), dtype=np.float64)
    rows, columns = (n // BLOCK_PX for n in grey.shape)
    cut = grey[: rows * BLOCK_PX, : columns * BLOCK_PX]
    return cut.reshape(rows, BLOCK_PX, columns, BLOCK_PX).mean(axis=(1, 3)).round()


def difference(now: NDArray[np.float64], before: NDArray[np.float64]) -> str:
    """What is different beyond the tolerances, in words; empty when nothing is."""
    if now.shape != before.shape:
        return f"{now.shape} blocks, {before.shape} stored"
    apart = np.abs(now - before)
    share, mean = float(np.mean(apart > DIFFERENT)), float(apart.mean())
    if share <= MOST_BLOCKS and mean <= MOST_MEAN:
        return ""
    rows, columns = np.nonzero(apart > DIFFERENT)
    where = (
        f", x {columns.min() * BLOCK_PX} to {(columns.max() + 1) * BLOCK_PX}, "
        f"y {rows.min() * BLOCK_PX} to {(rows.max() + 1) * BLOCK_PX} px"
        if rows.size
        else ""
    )
    return f"{100 * share:.1f} % of the blocks are others, {mean:.1f} of 255 on average{where}"


def take(tab: Any, view: str) -> bytes:
    """A picture of ``view`` when everything in it has been drawn."""
    show(tab, view)
    tab.wait_for_function(STEADY.get(view, "true"))
    tab.wait_for_timeout(400)
    return tab.screenshot(animations="disabled")


@pytest.mark.parametrize("frame", FRAMES)
def test_views_look_as_they_did(browser: Any, still: Still, frame: str):
    width, height, theme = FRAMES[frame]
    storing = os.environ.get("MICRON_STORE_PICTURES") == "1"
    context = browser.new_context(
        viewport={"width": width, "height": height},
        bypass_csp=True,
        color_scheme=theme,
        reduced_motion="reduce",
        timezone_id="UTC",
        locale="en-GB",
    )
    try:
        tab = context.new_page()
        tab.add_init_script(f"localStorage.setItem('micron.scope.2', {json.dumps(json.dumps(SCOPE))})")
        tab.goto(still.address)
        tab.wait_for_function("window.micron && micron.link.state && micron.link.mayOrder")
        widths = tab.evaluate(WIDTHS)
        if storing:
            STORED.mkdir(exist_ok=True)
            FONTS.write_text(json.dumps(widths) + "\n", encoding="utf-8")
        elif widths != json.loads(FONTS.read_text(encoding="utf-8")):
            pytest.skip(f"other fonts than those of the stored pictures: letters are {widths} wide")
        # the folder's name is another one in every run, the rate of frames is a measurement
        tab.add_style_tag(content=".list h2 small, .setup h2 small, .rate { visibility: hidden }")
        wrong: dict[str, str] = {}
        for view in VIEWS:
            png = take(tab, view)
            file = STORED / f"{view}-{frame}.png"
            now = blocks_of(png)
            if storing:
                Image.fromarray(now.astype(np.uint8), "L").save(file, optimize=True)
            elif said := difference(now, np.asarray(Image.open(file), dtype=np.float64)):
                ARTEFACTS.mkdir(parents=True, exist_ok=True)
                (ARTEFACTS / f"{view}-{frame}-now.png").write_bytes(png)
                wrong[view] = said
        assert not wrong, f"{wrong}; see out/browser, and MICRON_STORE_PICTURES=1 if it is meant"
    finally:
        context.close()


@pytest.mark.parametrize("frame", FRAMES)
def test_the_comparison_sees_a_button_that_is_gone_and_a_line_that_moved(frame: str):
    before = np.asarray(Image.open(STORED / f"tremor-{frame}.png"), dtype=np.float64)
    assert difference(before, before) == ""
    assert difference(before + 0.5, before) == "", "a shade is no change"
    width = FRAMES[frame][0]
    rows, columns = slice(0, 6), slice((width - 124) // BLOCK_PX, (width - 8) // BLOCK_PX)
    without_button = before.copy()
    without_button[rows, columns] = np.median(before[:6])
    assert "blocks are others" in difference(without_button, before)
    assert "blocks are others" in difference(np.roll(before, 2, axis=0), before)
    for other in READY:
        if other != "tremor":
            assert difference(np.asarray(Image.open(STORED / f"{other}-{frame}.png"), dtype=np.float64), before)
