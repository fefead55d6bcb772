"""The page of the endoscope: it shows what that instrument publishes, holds and records, without a line of its own."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner
from websockets.sync.client import ClientConnection, connect

from firmware_py.endoscope.frame import LAYOUT
from firmware_py.recording.reader import Recording
from tests.bench.conftest import READY, Server, bench_server, go, opened_tab
from tools.bench.wire import HEADER
from tools.cli.main import app

pytestmark = pytest.mark.timeout(300)


@pytest.fixture(scope="module")
def endoscope() -> Iterator[Server]:
    with bench_server(name="endoscope") as server:
        yield server


def ask(ws: ClientConnection, server: Server, **message: Any) -> None:
    ws.send(json.dumps({"type": "hello", "token": server.token}))
    ws.send(json.dumps(message))


def values(ws: ClientConnection, subscription: int, rows: int) -> np.ndarray:
    """At least ``rows`` rows of a subscription, one row a bucket: time and low values [1 + channels, n]."""
    parts = [np.zeros((0, 0))]
    while sum(part.shape[1] for part in parts) < rows:
        message = ws.recv(30)
        if isinstance(message, bytes):
            _, number, channels, n, per_bucket, _, _ = HEADER.unpack_from(message)
            if number == subscription:
                assert per_bucket == 1
                t_s = np.frombuffer(message, "<f8", n, HEADER.size)
                low = np.frombuffer(message, "<f4", n * channels, HEADER.size + 8 * n).reshape(channels, n)
                parts.append(np.vstack([t_s, low]))
    return np.hstack(parts[1:])


def test_the_channels_are_those_of_the_frames_that_it_publishes(endoscope: Server):
    found = endoscope.request("GET", "/api/channels")[1]
    assert found["instrument"] == "endoscope"
    assert tuple(c["name"] for c in found["channels"]) == LAYOUT.scalar_names()
    assert endoscope.state()["rate_hz"] == 100.0


def test_rows_come_at_the_rate_of_the_steering_sensor(endoscope: Server):
    with connect(endoscope.live, open_timeout=30) as ws:
        ask(ws, endoscope, type="subscribe", id=1, rows=500, pixels=8000, channels=["psi", "t", "held"])
        rows = values(ws, 1, 40)
        assert np.allclose(np.diff(rows[0]), 0.01, atol=0.004)
        assert np.allclose(rows[0], rows[2], atol=1e-3), "channels are columns of this instrument"
        for number, name in ((2, "tremor_x"), (3, "view_x")):  # the first is of the other instrument and is dropped
            table = {"type": "subscribe", "id": number, "rows": 500, "pixels": 8000, "channels": [name]}
            ws.send(json.dumps(table))
        assert 0.0 < values(ws, 3, 10)[1].mean() < 640.0


def test_a_silent_card_is_a_hold_on_the_page_and_in_the_recording(endoscope: Server):
    assert endoscope.request("POST", "/api/recording/start", b'{"name": "turning"}')[0] == 200
    endoscope.wait_for(lambda s: s["recording"]["written"] > 50, "rows")
    endoscope.inject("freeze", "card")
    state = endoscope.wait_for(lambda s: bool(s["status"]["hold"]), "the hold")
    assert state["alerts"][0]["text"].startswith("Hold, the view stands still: card: no sample for 500 ms")
    endoscope.inject("thaw", "card")
    state = endoscope.wait_for(lambda s: s["holds"] and s["holds"][-1]["to_s"] is not None, "the end of the hold")
    assert state["holds"][-1]["cause"].startswith("card: no sample")
    assert endoscope.request("POST", "/api/recording/stop", b"{}")[1]["problem"] == ""
    recording = Recording(endoscope.recordings / "turning.mcap")
    assert recording.names == LAYOUT.scalar_names()
    assert recording.array(["held"]).max() == 1.0
    assert (np.diff(recording.array(["t"])[:, 0]) > 0.0).all()
    look = endoscope.request("GET", "/api/recordings/turning/look?channels=psi,view_x")[1]
    assert look["channels"] == ["psi", "view_x"]
    assert len(look["holds"]) == 1


@pytest.mark.parametrize(
    ("path", "body", "message"),
    [
        ("/api/compare", {"method": "observer"}, "[firmware] fusion"),
        ("/api/filters/use", {"method": "observer"}, "another instrument"),
        ("/api/calibrate/poses", {"means_V": [[1.0] * 9] * 3}, "at least 12 poses"),
        ("/api/firmware/start", {"bench": "/etc/passwd"}, "is not one of the benches"),
        ("/api/targets/start", {"source": "joystick"}, "there are mouse and card"),
    ],
)
def test_bad_input_is_one_message(endoscope: Server, path: str, body: dict[str, Any], message: str):
    status, answer = endoscope.request("POST", path, json.dumps(body).encode())
    assert status == 400
    assert message in answer["error"]
    assert "\n" not in answer["error"]


def test_a_hand_belongs_to_the_first_instrument(tmp_path: Path):
    recordings = tmp_path / "recordings"
    result = CliRunner().invoke(
        app, ["bench", "--bench", "endoscope", "--hand", "x.npz", "--recordings", str(recordings)]
    )
    assert result.exit_code == 2
    assert result.output.strip() == "micron: --hand belongs to the instrument; an endoscope bench has none"
    assert not recordings.exists(), "nothing half written"


def test_the_card_that_runs_plays_the_targeting_experiment(endoscope: Server):
    endoscope.wait_running()
    endoscope.wait_for(lambda s: s["status"]["t_s"] > 14.0, "the end of the presses that the bench file plans")
    start = json.dumps({"user": "robot", "source": "card", "seed": 3}).encode()
    assert endoscope.request("POST", "/api/targets/start", start)[0] == 200
    rows = endoscope.state()["rows"]
    with connect(endoscope.live, open_timeout=30) as ws:
        ask(ws, endoscope, type="game", on=True)
        endoscope.inject("press", "card")
        endoscope.wait_for(lambda s: s["rows"] > rows + 30, "0.3 s")
        endoscope.inject("release", "card")
        games = (json.loads(m) for m in ws if isinstance(m, str))
        game = next(m["game"] for m in games if m["type"] == "game" and m["game"]["status"] == 1)
    assert (game["source"], game["clicks"]) == ("card", 1)


def test_the_browser_shows_its_views_and_no_others(browser: Any, endoscope: Server):
    endoscope.wait_running()
    with opened_tab(browser, f"{endoscope.base}/#token={endoscope.token}", READY) as page:
        page.wait_for_function("micron.scope && micron.scope.traces.length")
        assert page.evaluate("micron.scope.traces.map((t) => t.name)") == ["psi", "theta", "view_x", "view_y"]
        views = page.evaluate("[...document.querySelectorAll('#nav a')].map((a) => a.dataset.view)")
        assert views == ["scope", "attitude", "latency", "targets", "collect", "mismatch", "setup"]
        page.wait_for_function("micron.scope.subscription.buckets.n > 50")
        for view in views[1:]:
            go(page, view)
        go(page, "latency")
        page.wait_for_selector("h2:has-text('From arrival to view')")
        page.wait_for_selector("text=arrival to view p50")
        go(page, "attitude")
        page.wait_for_function("document.getElementById('view').innerText.includes('°')")


def test_another_bench_is_started_in_setup_and_the_page_becomes_its_own(browser: Any, endoscope: Server):
    endoscope.wait_running()
    assert endoscope.request("POST", "/api/recording/start", b'{"name": "seen"}')[0] == 200
    own = endoscope.wait_for(lambda s: s["recording"]["written"] > 20, "rows")["bench_file"]
    with opened_tab(browser, f"{endoscope.base}/#token={endoscope.token}", READY) as page:
        go(page, "setup")
        page.select_option("select[aria-label='Bench to run']", label="bench.toml")
        page.click("text=Run it")  # ends the recording, too
        page.wait_for_selector("#nav a[data-view=tremor]")
        endoscope.wait_for(lambda s: s["rate_hz"] == 1000.0 and s["rows"] > 100, "rows of the first instrument")
        status, answer = endoscope.request("POST", "/api/targets/start", b'{"source": "card"}')
        assert (status, "no motion card" in answer["error"]) == (400, True)
        page.evaluate("micron.link.replayTo({ name: 'seen' })")
        page.wait_for_selector("#say:has-text('seen.mcap is a recording of another instrument')")
        back = json.dumps({"bench": own}).encode()
        assert endoscope.request("POST", "/api/firmware/start", back)[0] == 200
        endoscope.wait_for(lambda s: s["rate_hz"] == 100.0 and s["rows"] > 20, "rows of the endoscope")
