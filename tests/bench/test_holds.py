"""Holds as spans on the time axes of the page, and the four bands of the tremor view beside scipy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import signal

from firmware_py.endoscope import frame as endoscope_frame
from firmware_py.frame import LAYOUT, STATUS, FrameStatus
from tests.bench.conftest import go
from tests.bench.still import RATE_HZ, Still, made_up_rows
from tools.bench.hold_spans import MOST_SPANS, HoldSpans

pytestmark = pytest.mark.timeout(400)

CAUSE = "daq: no new scan for 5 ms"


def test_edges_are_those_of_the_rows_however_they_are_cut():
    t_s = np.arange(1000) / RATE_HZ
    rows = np.zeros((1000, LAYOUT.size))
    rows[100:150, STATUS] = rows[700:, STATUS] = FrameStatus.HELD | FrameStatus.SATURATED
    rows[400, STATUS] = np.nan
    held = LAYOUT.read_holds(LAYOUT.scalar_names(), rows)
    for cut in ([], [120], [100], [150], [99, 700, 999]):
        holds = HoldSpans()
        for part in np.split(np.arange(1000), cut):
            holds.follow(t_s[part], held[part])
        found = [(span.from_s, span.to_s) for span in holds.spans]
        assert found == [(t_s[100], t_s[150]), (t_s[700], None)], cut
        assert holds.current is holds.spans[-1]


def test_a_cause_belongs_to_its_hold_whichever_is_told_first():
    t_s, held, free = np.array([1.0]), np.array([True]), np.array([False])
    holds = HoldSpans()
    holds.name(CAUSE)  # the status line is faster than the rows
    holds.follow(t_s, held)
    holds.follow(t_s + 1, free)
    holds.name("")
    holds.follow(t_s + 2, held)  # the rows are faster
    assert [span.cause for span in holds.spans] == [CAUSE, ""]
    holds.name("supply: 4.2 V")
    holds.name("")
    holds.follow(t_s + 3, free)
    assert [span.cause for span in holds.spans] == [CAUSE, "supply: 4.2 V"]
    for k in range(2 * MOST_SPANS):
        holds.follow(np.array([10.0 + k]), held if k % 2 else free)
    assert len(holds.as_list()) == MOST_SPANS


@pytest.mark.parametrize("rows_first", [True, False])
def test_a_hold_that_no_status_told_is_named_by_the_outcome(rows_first: bool):
    """Emulated time passes fast while the DAQ is silent: the run is over before the page has read the hold's rows."""
    holds, t_s = HoldSpans(), np.array([3.0, 3.1, 9.0, 9.01])
    told = [{"t_s": 3.01, "cause": "supply: 4.2 V"}, {"t_s": 9.0, "cause": CAUSE}]
    holds.name("supply: 4.2 V")
    holds.follow(t_s[:2], np.array([True, False]))
    holds.name("")
    if rows_first:
        holds.follow(t_s[2:], np.array([True, True]))
    holds.name_by_outcome(told)
    if not rows_first:
        holds.follow(t_s[2:], np.array([True, True]))
    assert [span.cause for span in holds.spans] == ["supply: 4.2 V", CAUSE]


@pytest.fixture
def page(still: Still, still_page: Any) -> Any:
    if not still.session.holds.spans:
        t_s = made_up_rows()[:, LAYOUT.start("t")]
        still.session.holds.name(CAUSE)
        still.session.holds.follow(t_s, (t_s > 10.6) & (t_s < 11.1))
    return still_page


def test_every_time_axis_shows_the_hold_with_its_cause(page: Any):
    for view, strips in (("scope", 2), ("attitude", 1), ("tremor", 2), ("actuators", 1)):
        go(page, view)
        words = page.locator("#view .hold-words:not([hidden])")
        words.nth(strips - 1).wait_for()
        assert words.count() == strips
        assert f"hold 0.50 s: {CAUSE}" in words.first.inner_text()
    go(page, "scope")
    page.wait_for_function("micron.scope.strips[0].strip.spans.length === 1")
    shown = page.evaluate(
        """() => {
            const strip = micron.scope.strips[0].strip, [span] = strip.spans, u = strip.plot;
            const at = (x) => [...u.ctx.getImageData(u.valToPos(x, "x", true), u.bbox.top + 1, 1, 1).data.slice(0, 3)];
            return { from: span.x0, to: span.x1, inside: at((span.x0 + span.x1) / 2), outside: at(span.x0 - 0.05) };
        }"""
    )
    assert shown["to"] - shown["from"] == pytest.approx(0.5, abs=0.003)
    assert shown["inside"] != shown["outside"], "a band at the top marks the hold"


def test_the_spectrogram_has_it_as_well(page: Any):
    go(page, "scope")
    page.click("button[data-value=spectrogram]")
    warm = """() => {
        const c = document.querySelector(".analysis canvas"), g = c.getContext("2d");
        const row = g.getImageData(0, 19, c.width, 1).data;
        let n = 0;
        for (let i = 0; i < row.length; i += 4) if (row[i] === 245 && row[i + 1] === 176 && row[i + 2] === 66) n++;
        return n;
    }"""
    page.wait_for_function(f"({warm})() > 50")


def test_four_bands_beside_scipy(page: Any):
    rows, names = made_up_rows()[-4096:], LAYOUT.scalar_names()
    longer = made_up_rows()[-4098:]

    def of(table: np.ndarray, name: str) -> np.ndarray:
        return np.stack([table[:, names.index(f"{name}_{axis}")] for axis in "xyz"])

    motion = of(rows, "tip_displacement")
    left = motion - of(longer, "tremor_ahead")[:, :-2]  # commanded two ticks before, gain and confidence 1
    go(page, "tremor")
    page.wait_for_function("document.querySelector('.bands td:nth-child(2)').textContent !== ''")
    shown = [row.locator("td").all_inner_texts() for row in page.locator(".bands tr").all()[1:]]
    assert [row[0] for row in shown] == ["0–2", "2–8", "8–12", "20–500"]
    for (low, high), row in zip(((0.1, 2), (2, 8), (8, 12), (20, 500)), shown, strict=True):
        for data, text in ((motion, row[1]), (left, row[2])):
            hz, density = signal.periodogram(data, RATE_HZ, "hann", detrend="constant")
            inside = (hz >= low) & (hz < high)
            expected = 1e6 * np.sqrt(density[:, inside].sum() * hz[1])
            assert float(text) == pytest.approx(expected, rel=0.02, abs=0.006), row
    assert shown[2][3].startswith("−")


def test_each_instrument_says_its_holds_in_its_own_column():
    rows = np.zeros((3, endoscope_frame.LAYOUT.size))
    rows[1, endoscope_frame.HELD] = 1.0
    rows[2, endoscope_frame.OUTPUTS] = float(FrameStatus.HELD)  # there, the status is that of the card
    names = endoscope_frame.LAYOUT.scalar_names()
    assert endoscope_frame.LAYOUT.read_holds(names, rows).tolist() == [False, True, False]
    assert not LAYOUT.read_holds(("t", "volts_0"), np.ones((4, 2))).any(), "a recording without a status has no holds"
