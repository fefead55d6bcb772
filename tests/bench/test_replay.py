"""Recordings in the place of live data: seeking by the index, overview, two runs, spans, what cannot be opened."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_py.frame import LAYOUT, FrameStatus
from firmware_py.recording.cut import cut
from firmware_py.recording.errors import RecordingError
from firmware_py.recording.index import IndexedRecording
from firmware_py.recording.reader import Recording
from firmware_py.recording.recover import recover
from firmware_py.recording.writer import RecordingWriter
from tests.bench.conftest import go
from tests.bench.still import Still, made_up_rows, still_server
from tools.bench.history import History
from tools.bench.overview import EXTREMES, SPANS, summarize
from tools.bench.replay import Recorded, RecordedHistory, Replay
from tools.formats import netcdf
from tools.formats.export import FORMATS

pytestmark = pytest.mark.timeout(400)

NAMES = LAYOUT.scalar_names()
T, STATUS = LAYOUT.start("t"), LAYOUT.start("status")
CAUSE = "daq: no new scan for 5 ms"


def write(
    path: Path, seconds: float, *, from_s: float = 30.0, missing: range = range(0), gain: float = 1.0
) -> np.ndarray:
    """A recording of the made-up run, again and again, as the page records one; rows [n, columns]."""
    made = made_up_rows()
    n = round(seconds * 1000)
    rows = made[np.arange(n) % len(made)]
    rows[:, 0] = np.arange(n)
    rows[:, T] = from_s + np.arange(n) / 1000.0
    rows[:, NAMES.index("tip_displacement_x")] *= gain
    rows[2000:2500, STATUS] = float(FrameStatus.HELD)
    keep = np.array([k not in missing for k in range(n)])
    writer = RecordingWriter(path, list(zip(NAMES, LAYOUT.scalar_units(), strict=True)), {"tick_hz": "1000.0"})
    for first in range(0, n, 100):
        part = np.flatnonzero(keep[first : first + 100]) + first
        if first == 2100:
            writer.write_event(0, {"event": "hold begins", "reason": CAUSE})
            writer.write_event(1, {"event": "note", "text": "cable moved"})
        if len(part) == 100:
            writer.write_block(first, rows[part])
    writer.finish({"ended": "stopped", "rows_pushed": n, "events_pushed": 2})
    return rows


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    path = tmp_path_factory.mktemp("replay") / "run.mcap"
    return path, write(path, 20.0)


def test_any_place_is_read_without_what_is_before(recording: tuple[Path, np.ndarray], monkeypatch: pytest.MonkeyPatch):
    path, rows = recording
    opened = IndexedRecording(path)
    read: list[int] = []
    monkeypatch.setattr(opened, "_read", lambda k, real=opened._read: (read.append(k), real(k))[1])
    for from_s, to_s in ((30.0, 30.05), (41.234, 41.3), (49.95, 50.0)):
        read.clear()
        chunks = opened.chunks_between(from_s, to_s)
        t_s = np.concatenate([opened.chunk(k).t_s for k in chunks])
        expected = rows[(rows[:, T] >= from_s) & (rows[:, T] <= to_s), T]
        assert set(expected) <= set(t_s)
        assert len(chunks) <= 3
        assert len(read) <= 3, "the index says where it is"
    opened.close()


def test_half_an_hour_costs_a_seek_as_many_chunks_as_a_short_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The time is measured by benchmarks.bench_page; here the work is counted."""
    write(tmp_path / "a.mcap", 180.0)
    history = RecordedHistory(tmp_path / "a.mcap", LAYOUT)
    opened = history._recording
    read: list[int] = []
    monkeypatch.setattr(opened, "_read", lambda k, real=opened._read: (read.append(k), real(k))[1])
    for place in (170_000, 3_000, 90_000):
        read.clear()
        history.head = place
        history.buckets(np.arange(20), 1, place - 2600)
        assert 0 < len(read) <= 28
    history.close()


def test_it_answers_as_the_live_history_does(recording: tuple[Path, np.ndarray], tmp_path: Path):
    path, rows = recording
    live = History(LAYOUT)
    live.append(rows)
    replay = RecordedHistory(path, LAYOUT)
    replay.head = len(rows)
    channels = np.array([NAMES.index(n) for n in ("volts_3", "t", "command_2", "status")])
    for k, first, stop in ((1, 100, 700), (7, 40, 90), (1, 19_000, None)):
        a, b = live.buckets(channels, k, first, stop), replay.buckets(channels, k, first, stop)
        assert b.first == a.first
        assert np.allclose(b.t_s, a.t_s)
        assert np.allclose(b.low, a.low)
        assert np.allclose(b.high, a.high)
    summarize(path, tmp_path, 1000.0)
    fine = replay.buckets(channels, 64, 10, 300)
    replay.use_overview(tmp_path / EXTREMES, replay.n_entries)
    whole = 18_000 // 64  # the last entries of the live history are incomplete
    for k, first, stop in ((64, 10, whole), (16, 0, 1100), (160, 3, 100)):
        a, b = live.buckets(channels, k, first, stop), replay.buckets(channels, k, first, stop)
        assert np.allclose(b.low, a.low), k
        assert np.allclose(b.high, a.high), k
    assert np.allclose(fine.low, replay.buckets(channels, 64, 10, 300).low)
    assert not np.isnan(replay.buckets(channels, 64, 0).high).any()
    spans = json.loads((tmp_path / SPANS).read_text())
    assert spans["holds"][0] == {"from_s": pytest.approx(32.0), "to_s": pytest.approx(32.5), "cause": CAUSE}
    assert [note["text"] for note in spans["notes"]] == ["cable moved"]
    assert spans["lost"] is False
    replay.close()


def test_where_ticks_are_missing_nothing_is_made_up(tmp_path: Path):
    rows = write(tmp_path / "gap.mcap", 6.0, missing=range(3000, 3400))
    replay = RecordedHistory(tmp_path / "gap.mcap", LAYOUT)
    replay.head = replay.n_rows
    found = replay.buckets(np.array([NAMES.index("volts_0")]), 1, 2900, 3500)
    assert np.isnan(found.low[0, 100:500]).all()
    assert np.allclose(found.low[0, 500:], rows[3400:3500, NAMES.index("volts_0")])
    assert np.allclose(found.t_s, rows[2900:3500, T])
    replay.close()


def test_a_span_is_a_recording_of_its_own(recording: tuple[Path, np.ndarray], tmp_path: Path):
    path, rows = recording
    n = cut(Recording(path), tmp_path / "span.mcap", 31.95, 33.05)
    inside = rows[(rows[:, T] >= 31.95) & (rows[:, T] < 33.05)]
    assert n == len(inside)
    span = Recording(tmp_path / "span.mcap")
    assert not span.health.lost, span.health.lines()
    assert np.array_equal(span.array(NAMES), inside)
    assert [event.content["event"] for event in span.events] == ["hold begins", "note"]
    assert span.metadata["tick_hz"] == "1000.0"
    for made in (tmp_path / "span.mcap", tmp_path / "recovered.mcap"):
        if made.stem == "recovered":
            (tmp_path / "torn.mcap").write_bytes(path.read_bytes()[:-3000])
            assert recover(tmp_path / "torn.mcap", made).rows > 15_000
        opened = RecordedHistory(made, LAYOUT)  # events lie beside the ticks of their time: the index can be searched
        assert opened.n_rows == Recording(made).n_rows
        opened.close()
    with pytest.raises(RecordingError, match="no ticks between 90 and 91 s"):
        cut(Recording(path), tmp_path / "none.mcap", 90, 91)
    assert not (tmp_path / "none.mcap").exists()


@pytest.mark.parametrize("left", [0, 7, 40, 3000, -1, -30, -400])
def test_a_torn_file_is_one_message(recording: tuple[Path, np.ndarray], tmp_path: Path, left: int):
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(recording[0].read_bytes()[:left])
    with pytest.raises(RecordingError, match=r"no index: it was torn|is not a recording|no column layout"):
        RecordedHistory(torn, LAYOUT)


def test_a_place_beyond_the_ends_is_the_end(recording: tuple[Path, np.ndarray]):
    async def moves() -> None:
        replay = Replay(Recorded(recording[0], LAYOUT))
        history = replay.first.history
        replay.seek(-5.0)
        assert (replay.position_s, history.head) == (0.0, 1)
        replay.seek(1e9)
        assert (replay.position_s, history.head) == (history.length_s, history.n_rows)
        replay.play(True)  # at the end: from the start again
        assert replay.position_s == 0.0
        second = Recorded(recording[0], LAYOUT)
        await replay.lay_over(second, 2.0)
        replay.seek(5.0)
        assert (history.head, second.history.head) == (5001, 7001)
        await replay.close()

    asyncio.run(moves())


# -- in the page ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def still(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Still]:
    folder = tmp_path_factory.mktemp("page") / "recordings"
    with still_server(folder) as served:
        write(folder / "run one.mcap", 20.0)
        write(folder / "run two.mcap", 20.0, from_s=5.0, gain=2.0)
        (folder / "torn.mcap").write_bytes((folder / "run one.mcap").read_bytes()[:-3000])
        with_other = RecordingWriter(folder / "pump.mcap", [("t", "s"), ("flow", "l/s"), ("pressure", "Pa")], {})
        with_other.write_block(0, np.column_stack([np.arange(100) / 10, np.ones(100), np.ones(100)]))
        with_other.finish({"ended": "done", "rows_pushed": 100, "events_pushed": 0})
        yield served


@pytest.fixture
def page(still_page: Any) -> Any:
    return still_page


def row(page: Any, name: str) -> Any:
    return page.locator("tr", has=page.get_by_role("button", name=name, exact=True))


def open_run(page: Any, name: str = "run one") -> None:
    go(page, "collect")
    row(page, name).locator("button", has_text="Open").click()
    page.wait_for_selector("#replay:not([hidden])")
    page.wait_for_function("micron.link.replay && micron.link.replay.progress === 1 && micron.link.replay.holds.length")
    page.wait_for_function(
        "document.getElementById('view').dataset.view === 'scope' && micron.scope.subscription.buckets.n > 100"
    )


NEWEST = "(() => { const t = micron.scope.subscription.buckets.times(); return t[t.length - 1]; })()"


def test_a_run_is_opened_scrubbed_and_played_in_the_same_views(page: Any):
    open_run(page)
    assert "run one" in page.locator("#replay").inner_text()
    assert page.locator("#safe").is_visible()
    page.evaluate("micron.link.replayTo({ seek: 3.0 })")
    page.wait_for_function(f"Math.abs({NEWEST} - 33.0) < 0.01")
    scrub = page.locator("[aria-label='Place in the recording']")
    scrub.fill("7500")
    page.wait_for_function(f"Math.abs({NEWEST} - 45.0) < 0.05")
    page.evaluate("micron.link.replayTo({ seek: 3.0 })")
    page.wait_for_function(f"Math.abs({NEWEST} - 33.0) < 0.01")
    assert page.evaluate("micron.scope.subscription.buckets.n") > 1500
    page.wait_for_function("micron.scope.strips.every(({ strip }) => strip.spans.length === 1)")
    assert CAUSE in page.locator(".hold-words").first.inner_text()
    for view in ("tremor", "attitude", "actuators"):
        go(page, view)
        page.wait_for_selector("#view .hold-words:not([hidden])")
    assert page.locator("#arm").is_disabled()
    assert "go back to live" in page.locator("#view").inner_text()
    go(page, "latency")
    page.wait_for_selector("text=A recording holds no timing")
    go(page, "scope")
    page.click("#replay >> text=Play")
    page.wait_for_function("micron.link.replay.playing && micron.link.replay.position_s > 3.3")
    page.click("#replay >> text=Pause")
    page.wait_for_function("!micron.link.replay.playing")
    page.click("text=Back to live")
    page.wait_for_selector("#replay", state="hidden")
    page.wait_for_function(f"Math.abs({NEWEST} - 11.999) < 0.01")


def test_a_list_that_did_not_change_keeps_its_buttons(page: Any):
    """A button that is made anew between the press and the release of a finger does nothing."""
    go(page, "collect")
    row(page, "run one").locator("button", has_text="Open").wait_for()
    page.evaluate("window.pressed = document.querySelector('.collect tbody button')")
    with page.expect_response("**/api/recordings"):
        page.evaluate("micron.link.emit('server', '')")
    page.wait_for_timeout(100)  # the answer is taken
    assert page.evaluate("pressed.isConnected")


def test_two_runs_lie_over_one_another(page: Any):
    open_run(page)
    page.select_option("[aria-label='Second run over it']", "run two")
    page.wait_for_function("micron.scope.over && micron.scope.over.buckets.n > 100")
    page.evaluate(
        "micron.scope.settings.trigger.on = false; micron.scope.changed(); micron.link.replayTo({ seek: 8.0 })"
    )
    page.wait_for_function(f"Math.abs({NEWEST} - 38.0) < 0.01")
    ratio = """() => {
        const { strip } = micron.scope.strips[0], y = strip.plot.data, n = 3;
        const rms = (v) => { const w = v.filter((x) => x !== null), m = w.reduce((s, x) => s + x, 0) / w.length;
            return Math.sqrt(w.reduce((s, x) => s + (x - m) ** 2, 0) / w.length); };
        return y.length === 1 + 3 * n ? [0, 1].map((i) => rms([...y[1 + 2 * n + i]]) / rms([...y[1 + i]])) : null;
    }"""
    page.wait_for_function(f"(({ratio})() || [])[0] > 1.5")
    assert page.evaluate(ratio) == pytest.approx([2.0, 1.0], abs=0.02), "x is twice as large in the second run"
    page.fill("[aria-label='Shift of the second run, s']", "0.25")
    page.keyboard.press("Tab")
    page.wait_for_function("micron.link.replay.shift_s === 0.25")
    page.select_option("[aria-label='Second run over it']", "")
    page.wait_for_function("!micron.link.replay.second && !micron.scope.over")


def test_a_marked_span_is_exported_and_sent_to_mismatch(page: Any, still: Still, tmp_path: Path):
    open_run(page)
    page.evaluate("micron.link.replayTo({ seek: 4.0 })")
    page.wait_for_function(f"Math.abs({NEWEST} - 34.0) < 0.01")
    page.evaluate("micron.scope.setCursor(-1.0, false); micron.scope.setCursor(-0.5, false)")
    page.click("text=Mark A to B")
    length = page.evaluate("micron.context.bar.mark.to - micron.context.bar.mark.from")
    assert length == pytest.approx(0.5)
    with page.expect_download(timeout=120_000) as download:
        page.select_option("[aria-label='Export the marked span']", "nc")
    download.value.save_as(tmp_path / "span.nc")
    t = netcdf.read(tmp_path / "span.nc", ["t"])["t"]
    assert t[-1] - t[0] == pytest.approx(0.5, abs=0.003)
    offered = page.locator("[aria-label='Export the marked span'] option").all()
    assert [option.get_attribute("value") for option in offered] == ["", "recording", *FORMATS]
    page.click("text=To Mismatch")
    page.wait_for_function("document.getElementById('view').dataset.view === 'mismatch'", timeout=120_000)
    page.wait_for_function("document.querySelector('[aria-label=Recording]').value.startsWith('run one 3')")
    assert "cutting" not in page.locator("#replay").inner_text(), "what is done is not said to go on"
    assert len(list(still.session.recorder.folder.glob("run one 3*.mcap"))) == 1


@pytest.mark.parametrize(
    ("name", "said"),
    [("torn", "micron recover"), ("pump", "recording of another instrument"), ("first hand", "not a recording")],
)
def test_what_cannot_be_shown_is_one_message_and_nothing_is_lost(page: Any, name: str, said: str):
    open_run(page)
    go(page, "collect")
    row(page, name).locator("button", has_text="Open").click()
    page.wait_for_function(f"document.querySelector('#replay [role=alert]').textContent.includes('{said}')")
    assert page.evaluate("micron.link.replay.name") == "run one"
    page.click("text=Back to live")
    page.wait_for_selector("#replay", state="hidden")
    go(page, "collect")
    row(page, name).locator("button", has_text="Open").click()
    page.wait_for_function(f"document.getElementById('say').textContent.includes('{said}')")


def test_a_torn_recording_is_made_whole_from_the_list(page: Any, still: Still):
    go(page, "collect")
    torn = still.session.recorder.folder / "torn.mcap"
    before = torn.read_bytes()
    page.select_option("[aria-label='Export torn']", "recover")
    page.locator("h2", has_text="torn recovered").wait_for()
    assert torn.read_bytes() == before
    assert Recording(torn.with_name("torn recovered.mcap")).n_rows > 15_000
    page.select_option("[aria-label='Export torn']", "recover")
    page.wait_for_function("document.querySelector('.collect [role=alert]').textContent.includes('already')")
    row(page, "torn recovered").locator("button", has_text="Open").click()
    page.wait_for_function("micron.link.replay && micron.link.replay.name === 'torn recovered'")
