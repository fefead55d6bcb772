"""The scope of the page: what it opens on, what it computes (beside scipy), where it draws, what it says.

Over data that stand still (tests/bench/still.py): no firmware, no real time.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from scipy import signal

from firmware_py.frame import LAYOUT
from tests.bench.conftest import go
from tests.bench.still import TREMOR_HZ, made_up_rows

pytestmark = pytest.mark.timeout(400)

TIP = ["tip_displacement_x", "tip_displacement_y", "tip_displacement_z"]
COMMANDS = ["command_1", "command_2", "command_3"]
FRAMES = "() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => setTimeout(done, 60))))"


READY = "window.micron && micron.scope && micron.scope.subscription.buckets.n > 100"


@pytest.fixture
def scope(still_page: Any) -> Any:
    """The scope as it opens, drawn."""
    still_page.wait_for_function(READY)
    still_page.evaluate(FRAMES)
    return still_page


def use(scope: Any, **settings: Any) -> None:
    """Other settings, drawn."""
    scope.evaluate("(s) => { Object.assign(micron.scope.settings, s); micron.scope.changed(); }", settings)
    scope.wait_for_function("micron.scope.subscription.buckets.n > 100")
    scope.evaluate(FRAMES)


def column(name: str) -> np.ndarray:
    return made_up_rows()[:, LAYOUT.scalar_names().index(name)]


NO_TRIGGER = {"on": False, "channel": "volts_0", "level": 0, "slope": "up", "mode": "auto"}


def test_it_opens_on_tip_and_commands_with_units_and_a_trigger(scope: Any):
    traces = scope.evaluate("micron.scope.traces.map((t) => [t.name, t.set.coupling, t.set.filter])")
    assert traces == [[name, "ac", "high"] for name in TIP] + [[name, "ac", "none"] for name in COMMANDS]
    ticks = scope.evaluate("micron.scope.strips.map(({ strip }) => strip.ticks(strip.plot).map((t) => t.text))")
    assert all(re.fullmatch(r"0|-?[0-9.]+ µm", text) for text in ticks[0])
    assert all(re.fullmatch(r"0|-?[0-9.]+ V", text) for text in ticks[1])
    assert scope.evaluate("micron.scope.strips.at(-1).strip.plot.axes[0].label") == "time, s"
    assert scope.locator("text=Trigger >> visible=true").count()
    marks = scope.evaluate("micron.scope.strips[0].strip.marks.filter((m) => m.label === 'T').length")
    assert marks == 2, "its level and its instant"


def test_a_view_that_is_asked_for_twice_at_once_is_there_once(scope: Any):
    scope.evaluate("() => { micron.context.reload('scope'); micron.context.reload('scope'); }")
    scope.wait_for_function(READY)
    scope.evaluate(FRAMES)
    assert scope.locator("#view .scope").count() == 1
    assert scope.evaluate("micron.link.subscriptions.size") == 1


def test_the_trigger_holds_where_the_trace_rises_through_the_level(scope: Any):
    held_s = scope.evaluate("micron.scope.trigger.heldAt")
    assert held_s > 0
    b, a = signal.butter(2, 2.0, "high", fs=1000.0)
    tip = column(TIP[0])[-2600:]
    drawn = signal.lfilter(b, a, tip, zi=signal.lfilter_zi(b, a) * tip[0])[0]
    at = round(held_s * 1000) - (12_000 - 2600)
    slope = drawn[at + 5] - drawn[at - 5]
    assert slope > 0
    assert abs(drawn[at] - drawn.mean()) < 0.3 * slope
    assert f"Triggered at {held_s:.3f} s" in scope.locator(".trigger").inner_text()


def test_the_axis_says_the_division_that_is_drawn(scope: Any):
    """A lane that is scaled while it is looked at: the range of uPlot's axis stays, its labels change."""
    use(scope, channels=["command_1"], trigger=NO_TRIGGER)
    scope.evaluate(
        """() => {
            const g = micron.scope.strips[0].strip.plot.ctx, real = g.fillText;
            window.written = [];
            g.fillText = function (text, ...where) { window.written.push(text); return real.call(g, text, ...where); };
            micron.scope.traces[0].set = { ...micron.scope.traces[0].set, div: 200 };
            micron.scope.setCursor(-0.5, false);
        }"""
    )
    scope.evaluate(FRAMES)
    written = scope.evaluate("window.written.filter((text) => text.endsWith(' V'))")
    assert written[-2:] == ["-200 V", "200 V"]


def test_no_label_of_an_axis_is_cut(scope: Any):
    """A label that is too wide loses its sign first."""
    maths = [{"op": "derivative", "a": name, "b": ""} for name in ("tip_displacement_x", "specific_force_x")]
    channels = ["rate_x", "specific_force_x", "magnetometer_x", "tip_displacement_x", "volts_0", "quaternion_x"]
    use(scope, channels=channels, maths=maths, trigger=NO_TRIGGER)
    seen = scope.evaluate(
        """micron.scope.strips.map(({ strip, divs }) => {
            const { plot } = strip;
            const widest = () => {
                plot.ctx.font = "10px " + getComputedStyle(document.documentElement).getPropertyValue("--mono");
                return Math.max(...strip.ticks(plot).map((t) => plot.ctx.measureText(t.text).width));
            };
            const drawn = widest();
            const all = [1e-4, 5e-3, 0.05, 0.2, 50].map((div) => { divs.fill(div); return widest(); });
            return [Math.max(drawn, ...all), plot.bbox.left / devicePixelRatio];
        })"""
    )
    assert len(seen) >= 6
    assert len({left for _, left in seen}) == 1, "times lie under one another"
    for width, left in seen:
        assert width <= left - 8


def test_eight_inputs_have_eight_lanes_and_each_is_seen(scope: Any):
    use(scope, channels=[f"volts_{i}" for i in range(8)], trigger=NO_TRIGGER)
    lanes = scope.evaluate(
        """micron.scope.strips[0].strip.plot.data.slice(1, 9).map((y) => [Math.min(...y), Math.max(...y)])"""
    )
    for i, (low, high) in enumerate(lanes):
        assert 7 - i <= low < high <= 8 - i, f"volts_{i} leaves its lane"
        assert high - low > 0.2, f"volts_{i} is flat"
    low_lanes = scope.evaluate("micron.scope.strips[0].strip.options.ticks(8 * 25)")  # no room for divisions
    assert [tick["text"] for tick in low_lanes] == ["0 V"] * 8


def test_a_trace_a_hundred_times_smaller_is_seen_as_well(scope: Any):
    use(scope, channels=["command_1", "tip_displacement_x", "temperature", "volts_0"], trigger=NO_TRIGGER)
    spans = scope.evaluate(
        """micron.scope.strips.flatMap(({ strip, members }) => members.map((_, i) => {
            const y = strip.plot.data[i + 1];
            return Math.max(...y) - Math.min(...y);
        }))"""
    )
    assert min(spans) > 0.2


@pytest.mark.parametrize(("kind", "hz", "q"), [("low", 30.0, 2**-0.5), ("high", 2.0, 2**-0.5), ("band", 9.8, 2.45)])
def test_filters_are_those_of_the_book(scope: Any, kind: str, hz: float, q: float):
    values = column("volts_0")[:3000]
    coefficients, out = scope.evaluate(
        """async ([values, kind, hz, q]) => {
            const { section, run } = await import("/static/signals.js");
            const c = section(kind, hz, q, 1000);
            return [c, [...run(Float64Array.from(values), c)]];
        }""",
        [values.tolist(), kind, hz, q],
    )
    b, a = np.array(coefficients[:3]), np.array([1.0, *coefficients[3:]])
    if kind == "band":
        # the analogue resonance, with its middle where it was
        expected_b, expected_a = signal.bilinear([1 / q, 0], [1, 1 / q, 1], fs=0.5 / np.tan(np.pi * hz / 1000.0))
    else:
        expected_b, expected_a = signal.butter(2, hz, kind, fs=1000.0)
    assert b == pytest.approx(expected_b, rel=1e-6, abs=1e-12)
    assert a == pytest.approx(expected_a, rel=1e-6)
    state = signal.lfilter_zi(b, a) * values[0]
    assert out == pytest.approx(signal.lfilter(b, a, values, zi=state)[0], abs=1e-9)


def test_where_a_recording_has_no_samples_nothing_is_computed(scope: Any):
    """Gaps, and what is not read yet, stay gaps; samples far from them are those of a recording without gaps."""
    a = column("volts_0")[:3000]
    found = scope.evaluate(
        """async (a) => {
            const { calculate, run, section } = await import("/static/signals.js");
            const whole = Float64Array.from(a), torn = whole.slice();
            torn.fill(NaN, 600, 700);
            const none = new Float64Array(50).fill(NaN);
            const ways = [(v) => run(v, section("high", 2, 0.7, 1000)), (v) => calculate("rms", v, null, 1000)];
            const text = (v) => [...v].map((y) => (y === y ? y : null));
            return ways.map((way) => [way(whole), way(torn), way(none)].map(text));
        }""",
        a.tolist(),
    )
    for whole, torn, none in found:
        assert [k for k, y in enumerate(torn) if y is None] == list(range(600, 700))
        assert none == [None] * 50
        assert torn[:600] == pytest.approx(whole[:600], abs=1e-12)
        assert torn[2500:] == pytest.approx(whole[2500:], abs=1e-6)


def test_maths_beside_numpy(scope: Any):
    a, b = column("volts_0")[:2000], column("volts_1")[:2000]
    found = scope.evaluate(
        """async ([a, b]) => {
            const { calculate } = await import("/static/signals.js");
            const [p, q] = [a, b].map((v) => Float64Array.from(v));
            return ["sum", "difference", "derivative", "rms"].map((op) => [...calculate(op, p, q, 1000)]);
        }""",
        [a.tolist(), b.tolist()],
    )
    assert found[0] == pytest.approx(a + b)
    assert found[1] == pytest.approx(a - b)
    assert found[2][1:-1] == pytest.approx(np.gradient(a, 1e-3)[1:-1])
    windows = np.lib.stride_tricks.sliding_window_view(a, 500)
    assert found[3][499:] == pytest.approx(windows.std(axis=1), abs=1e-9)


def test_a_computed_trace_is_drawn_with_its_unit(scope: Any):
    maths = [
        {"op": "derivative", "a": "tip_displacement_x", "b": ""},
        {"op": "difference", "a": "volts_0", "b": "volts_1"},
    ]
    use(scope, channels=[], maths=maths, trigger=NO_TRIGGER)
    assert scope.evaluate("micron.scope.traces.map((t) => t.unit)") == ["m/s", "V"]
    assert scope.evaluate("micron.scope.subscription.buckets.perBucket") == 1, "maths needs samples"
    lows = scope.evaluate("micron.scope.strips.map(({ strip }) => strip.plot.data[1].length)")
    assert min(lows) >= 2000


def test_steps_and_units_of_the_axes(scope: Any):
    steps, texts = scope.evaluate(
        """async () => {
            const { step125, withUnit } = await import("/static/signals.js");
            return [[0.0011, 0.02, 0.021, 3, 7, 10].map(step125),
                [[4e-5, "m"], [0.02, "V"], [2.1, "V"], [-3e-6, "m"], [9.81, "m/s²"], [0, "V"], [NaN, "V"], [12, ""]]
                    .map(([v, u]) => withUnit(v, u))];
        }"""
    )
    assert steps == pytest.approx([0.002, 0.02, 0.05, 5, 10, 10])
    assert texts == ["40 µm", "20 mV", "2.1 V", "-3 µm", "9.81 m/s²", "0 V", "–", "12"]


def test_what_is_outside_its_limits_is_red_and_counted(scope: Any):
    tip = column(TIP[0])[-2000:]
    limits = {"coupling": "ac", "div": "auto", "offset": 0, "filter": "band", "low": "", "high": "20"}
    use(scope, channels=[TIP[0]], traces={TIP[0]: limits}, trigger=NO_TRIGGER)
    said = scope.locator(".plot .legend").inner_text()
    share = float(re.search(r"([0-9.]+) % outside", said)[1])  # type: ignore[index]
    assert share == pytest.approx(100 * np.mean(tip > 20e-6), abs=4)
    red = scope.evaluate("micron.scope.strips[0].strip.plot.data[2].filter((v) => v !== null).length")
    assert red > 100
    assert scope.evaluate("micron.scope.strips[0].strip.values[0].classList.contains('bad')")


def test_cursors_give_differences_of_every_trace(scope: Any):
    use(scope, trigger=NO_TRIGGER)
    scope.evaluate("micron.scope.setCursor(-1.0, false); micron.scope.setCursor(-0.5, false)")
    scope.evaluate(FRAMES)
    said = scope.locator(".readout").inner_text()
    assert "Δ 500.00 ms" in said
    assert "2.000 Hz" in said
    for name in TIP + COMMANDS:
        assert f"{name} " in said
    tip = column(COMMANDS[0])
    found = float(re.search(r"command_1 \S+ V, Δ (\S+) V", said)[1])  # type: ignore[index]
    step = np.abs(np.diff(tip)).max() * 4
    assert found == pytest.approx(tip[-501] - tip[-1001], abs=step)


def test_spectra_have_the_tremor_where_it_is(scope: Any):
    found = scope.evaluate(
        """async (values) => {
            const { pieces } = await import("/static/views/scope_analysis.js");
            const p = pieces(Float64Array.from(values), 1000, 2.0);
            return p.columns.map((c) => c.indexOf(Math.max(...c)) * p.step);
        }""",
        column(TIP[0])[-8000:].tolist(),
    )
    assert len(found) > 10
    assert found == pytest.approx([TREMOR_HZ] * len(found), abs=0.5)


@pytest.mark.parametrize("mode", ["xy", "fft", "spectrogram"])
def test_other_ways_to_look_are_drawn_and_labelled(scope: Any, mode: str):
    scope.click(f"button[data-value={mode}]")
    scope.wait_for_function(
        "micron.scope.subscription.buckets.perBucket === 1 && micron.scope.subscription.buckets.n > 1500"
    )
    drawn = """() => {
        const c = document.querySelector(".analysis canvas");
        const data = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
        const seen = new Set();
        for (let i = 0; i < data.length; i += 4) if (data[i + 3]) seen.add(data.slice(i, i + 3).join());
        return seen.size;
    }"""
    scope.wait_for_function(f"({drawn})() > 20")
    assert scope.locator(".analysis").is_visible()
    assert not scope.locator(".plots").is_visible()


def test_cursors_in_the_spectrum_name_frequencies_and_amplitudes(scope: Any):
    use(scope, channels=[TIP[0]], trigger=NO_TRIGGER, rows=5000, mode="fft", top=30)
    scope.wait_for_function("micron.scope.subscription.buckets.perBucket === 1")
    scope.locator(".analysis .marks", has_text="Click sets cursor A").wait_for()
    scope.evaluate("micron.scope.analysed.setCursor([9.5, 0], false); micron.scope.analysed.setCursor([19, 0], false)")
    said = scope.locator(".analysis .marks").inner_text()
    assert "A 9.5 Hz" in said
    assert "Δ 9.5 Hz" in said
    amplitude_um = float(re.search(r"tip_displacement_x (\S+) µm", said)[1])  # type: ignore[index]
    samples = column(TIP[0])[-4096:]
    window = np.hanning(4097)[:-1]
    expected = np.abs(np.fft.rfft((samples - samples.mean()) * window))[round(9.5 / 1000 * 4096)] * 4 / 4096 * 1e6
    assert amplitude_um == pytest.approx(expected, rel=0.01)
    use(scope, channels=["clip", TIP[0]])  # nothing is clipped: a ratio to zero is not shown
    scope.evaluate("micron.scope.analysed.setCursor([9.5, 0], false); micron.scope.analysed.setCursor([19, 0], false)")
    scope.locator(".analysis .marks", has_text="clip").wait_for()
    said = scope.locator(".analysis .marks").inner_text()
    assert "NaN" not in said
    assert said.count("×") == 1
    box = scope.locator(".analysis canvas").bounding_box()
    assert box is not None
    x = box["x"] + 64 + (box["width"] - 74) / 3
    scope.mouse.click(x, box["y"] + box["height"] / 2)
    assert scope.evaluate("micron.scope.analysed.cursors[0][0]") == pytest.approx(10.0, abs=0.1)


@pytest.mark.parametrize("mode", ["xy", "spectrogram"])
def test_cursors_in_the_plane_have_differences_along_both_axes(scope: Any, mode: str):
    use(scope, channels=TIP, trigger=NO_TRIGGER, mode=mode, top=30)
    scope.locator(".analysis .marks", has_text="Click sets cursor A").wait_for()
    points = ([-1.0, 9.5], [-0.5, 20.0]) if mode == "spectrogram" else ([1e-5, -2e-5], [4e-5, 2e-5])
    scope.evaluate("(p) => p.forEach((c) => micron.scope.analysed.setCursor(c, false))", points)
    said = scope.locator(".analysis .marks").inner_text()
    if mode == "xy":
        assert "Δ 30 µm, 40 µm" in said
        assert "distance 50 µm" in said
    else:
        assert "Δ 0.5 s, 10.5 Hz" in said or "Δ 500 ms, 10.5 Hz" in said
        levels = re.findall(r"Hz: (\S+) (.?)m", said)
        assert float(levels[0][0]) > 5, "the tremor is at A"
    scope.click("button[data-value=fft]")
    scope.locator(".analysis .marks", has_text="Click sets cursor A").wait_for()


def test_settings_come_back_after_a_reload(scope: Any):
    use(scope, channels=["volts_3"], trigger=NO_TRIGGER, traces={"volts_3": {"offset": "1", "filter": "low"}})
    scope.reload()
    scope.wait_for_function("window.micron && micron.scope && micron.scope.traces.length === 1")
    trace = scope.evaluate("micron.scope.traces[0]")
    assert (trace["name"], trace["set"]["offset"], trace["set"]["filter"]) == ("volts_3", "1", "low")


def test_channels_of_different_units_do_not_add_up(scope: Any):
    scope.select_option("select[aria-label='Channel a']", "tip_displacement_x")
    scope.select_option("select[aria-label='Channel b']", "command_1")
    scope.click("text=Add trace")
    assert "they do not add up" in scope.locator(".own").inner_text()
    assert scope.evaluate("micron.scope.settings.maths.length") == 0


def test_every_figure_says_what_it_is(scope: Any):
    for view, selector in (
        ("scope", "#vitals dt"),
        ("latency", "thead th:not(:nth-child(3))"),
        ("tremor", "table th"),
        ("attitude", "td.soft"),
        ("actuators", ".big, .big + .num, .row.num > span"),
        ("collect", "thead th:nth-child(4)"),
    ):
        go(scope, view)
        scope.wait_for_selector(selector, state="attached")
        unexplained = scope.evaluate(
            f"[...document.querySelectorAll('{selector}')]"
            ".filter((e) => !e.matches('[data-hint][title]') && !e.querySelector('[data-hint][title]'))"
            ".map((e) => e.textContent)"
        )
        assert unexplained == []


def test_what_is_pointed_at_stays_while_its_value_changes(scope: Any):
    """A tooltip and a tap need an element that is still there a moment later."""
    for view, selector in (("attitude", "td.soft .what"), ("actuators", ".row.num .what")):
        go(scope, view)
        scope.wait_for_selector(selector)
        scope.evaluate(f"window.pointed = document.querySelector('{selector}')")
        scope.wait_for_timeout(300)  # several pictures
        assert scope.evaluate("pointed.isConnected")


def test_a_figure_is_explained_where_it_is_tapped(scope: Any):
    scope.locator("#vitals .what", has_text="outputs held").click()
    assert "Normal: 0 %" in scope.locator("#hint").inner_text()
    assert scope.locator("#vitals div", has_text="outputs held").locator("dd").inner_text() == "0 %"
    scope.locator("#view").click(position={"x": 3, "y": 3})
    assert not scope.locator("#hint").is_visible()


def test_budget_bars_have_a_line_at_a_hundred_percent(scope: Any):
    go(scope, "latency")
    scope.wait_for_function("document.querySelectorAll('.budget i').length >= 5")
    scope.wait_for_function("document.querySelector('.budget span').textContent !== ''")
    bars = scope.evaluate(
        """[...document.querySelectorAll(".budget")].map((b) => {
            const [track, fill, line] = [".track", "i", "b"].map((s) => b.querySelector(s).getBoundingClientRect());
            return [parseFloat(b.textContent), (fill.width) / track.width, (line.left - track.left) / track.width];
        })"""
    )
    assert [bar[0] for bar in bars] == [42, 80, 57, 60, 18]
    for percent, fill, line in bars:
        assert fill / line == pytest.approx(percent / 100, abs=0.03)
