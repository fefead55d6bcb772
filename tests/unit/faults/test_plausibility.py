"""What a scan may not do, found in the tick in which it does it."""

from __future__ import annotations

import numpy as np
import pytest

from firmware_py.control.plausibility import (
    PAIRS,
    PlausibilityLimits,
    ScanCheck,
    check_counts,
    turns_of_pairs,
)
from firmware_py.frame import ACCELEROMETER, LAYOUT
from firmware_py.records import attributes
from firmware_py.sensing.config import SensingConfig

LSB_V = 5.0 / 32768.0
LABELS = ("1x", "1z", "2y", "2z", "3x", "3y", "supply", "temperature")
LEVEL_V = np.array([2.6, 2.2, 3.5, 2.4, 2.5, 3.4, 2.5, 0.75])


def check(**limits: float) -> ScanCheck:
    return ScanCheck(PlausibilityLimits(**limits), LSB_V, range(8), LABELS)  # type: ignore[arg-type]


def scans(n: int, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.round((LEVEL_V + 0.001 * rng.standard_normal((n, 8))) / LSB_V).astype(np.int16)


def findings(made: ScanCheck, rows: np.ndarray) -> list[tuple[int, str]]:
    return [(k, text) for k, row in enumerate(rows) if (text := made.scan(row, k))]


def test_noise_around_any_level_is_plausible():
    assert findings(check(), scans(5000)) == []


@pytest.mark.parametrize(
    ("channel", "volts", "at", "words"),
    [
        (0, 0.0, 100, "1x is at the end of its range"),
        (3, 5.0, 100, "2z is at the end of its range"),
        (1, 2.3, 100, "1z jumped"),
        (7, 0.0, 100, "temperature is at the end"),
        (6, 2.2, 100, "supply jumped"),
    ],
)
def test_a_sudden_change_is_found_in_its_own_scan(channel: int, volts: float, at: int, words: str):
    rows = scans(200)
    rows[at:, channel] = round(min(volts, 4.9998) / LSB_V)
    first, text = findings(check(), rows)[0]
    assert first == at
    assert text.startswith(words)


def test_a_sag_of_the_supply_is_blamed_on_the_supply_not_on_a_sensor():
    rows = scans(200)
    rows[100:, :7] = (rows[100:, :7] * 0.9).astype(np.int16)
    assert findings(check(), rows)[0][1].startswith("supply jumped")


def test_a_stuck_sensor_is_found_when_its_noise_has_been_missing_for_twenty_scans():
    rows = scans(200)
    rows[100:, 4] = rows[100, 4]
    first, text = findings(check(), rows)[0]
    assert first == 120
    assert "3x has repeated one reading 20 times" in text


def test_the_supply_may_stand_still():
    rows = scans(200)
    rows[:, 6:] = rows[0, 6:]
    assert findings(check(), rows) == []


def test_what_may_have_changed_during_lost_scans_is_no_jump():
    rows = scans(2)
    rows[1, 0] += round(0.1 / LSB_V)
    made = check(jump_V=0.03)
    assert made.scan(rows[0], 0) == ""
    assert made.scan(rows[1], 5) == ""
    made = check(jump_V=0.03)
    made.scan(rows[0], 0)
    assert "jumped" in made.scan(rows[1], 1)


def test_parallel_axes_must_agree_slowly_and_may_differ_in_tremor():
    t = np.arange(5000) * 0.001
    made, frame = check(), LAYOUT.new_frame()
    for k in range(5000):
        frame[ACCELEROMETER + 4] = 1.0 * np.sin(2 * np.pi * 9.7 * t[k])
        assert made.pairs(frame) == ""
    assert made.odd() == ""
    frame[ACCELEROMETER + 4] = 1.0
    texts = [made.pairs(frame) for _ in range(300)]
    path = np.concatenate([np.sin(2 * np.pi * 9.7 * t), np.ones(300)])
    mean = np.convolve(path, np.full(100, 0.01), "valid")[4901:]
    assert next(k for k, text in enumerate(texts) if text) == np.flatnonzero(mean > 0.6)[0]
    assert "1x and 3x disagree" in texts[-1]


def test_a_value_out_of_line_is_noticed_and_noise_and_motion_are_not():
    t = np.arange(3000) * 0.001
    rng = np.random.default_rng(3)
    volts = np.tile(LEVEL_V, (3000, 1)) + 0.00015 * rng.standard_normal((3000, 8))
    volts[:, :6] += 0.1 * np.sin(2 * np.pi * 10.0 * t)[:, None]  # 0.1 g at 10 Hz: 0.4 mV of second difference
    rows = np.round(volts / LSB_V).astype(np.int16)
    made = check()
    assert findings(made, rows) == []
    assert made.odd() == ""
    rows[1500, 3] ^= 1 << 6  # 9.8 mV in one reading
    made = check()
    assert findings(made, rows) == []
    assert "2z read a value out of line" in made.odd()
    assert made.odd() == ""  # told once


def test_a_step_of_the_supply_by_one_percent_is_noticed():
    rows = scans(200, seed=2)
    rows[:, 6] = round(2.5 / LSB_V)
    rows[100:, 6] -= round(0.0125 / LSB_V)
    made = check(outlier_V=1.0)
    assert findings(made, rows) == []
    assert made.odd() == "supply stepped"


def test_a_supply_that_sags_bends_all_axes_together_and_one_axis_does_not():
    """1 % of each reading behind a filter of 15 Hz; the sag comes anywhere within a scan."""
    for within in (0.05, 0.5, 0.95):
        late_ms = np.maximum(0.0, np.arange(300) - 150 + within)
        part = 1.0 - np.exp(-late_ms / 10.6)
        rng = np.random.default_rng(7)
        volts = LEVEL_V - 0.01 * LEVEL_V * part[:, None] + 0.0001 * rng.standard_normal((300, 8))
        made = check()
        assert findings(made, np.round(volts / LSB_V).astype(np.int16)) == []
        assert not made.stepped_together  # 150 scans ago
        made = check()
        findings(made, np.round(volts[:170] / LSB_V).astype(np.int16))
        assert made.stepped_together
        alone = LEVEL_V + 0.0001 * rng.standard_normal((300, 8))
        alone[:, 3] -= 0.025 * part
        made = check()
        findings(made, np.round(alone[:170] / LSB_V).astype(np.int16))
        assert not made.stepped_together


def test_a_new_difference_of_parallel_axes_is_noticed_and_an_old_one_is_not():
    made, frame = check(), LAYOUT.new_frame()
    rng = np.random.default_rng(4)
    for _ in range(3000):
        frame[ACCELEROMETER + 1] = 0.4 + 0.003 * rng.standard_normal()
        assert made.pairs(frame) == ""
    assert made.odd() == ""
    first = None
    for k in range(30):  # 1 V/s is 9.8 m/s^3
        frame[ACCELEROMETER + 1] = 0.4 + 0.0098 * k + 0.003 * rng.standard_normal()
        assert made.pairs(frame) == ""
        if first is None and (told := made.odd()):
            first = k
            assert told == "1z and 2z came apart along z"
    # 0.03 m/s^2 and six times the mean size of that noise, 0.0024
    assert first is not None
    assert 3 <= first <= 7


def readings(alpha: np.ndarray) -> np.ndarray:
    """(6,) m/s^2 of axes that turn with ``alpha``: s . (alpha x r), docs/references.md, conventions."""
    config = SensingConfig()
    return np.array([s @ np.cross(alpha, r) for s, r in zip(config.axes, config.axis_positions(), strict=True)])


def test_turns_across_the_instrument_are_no_difference_and_a_drift_is():
    config = SensingConfig()
    mix = turns_of_pairs(config.axis_positions(), np.array(config.axes))
    assert mix[0].tolist() == [1.0, 0.0, 0.0]
    assert mix[2].tolist() == [0.0, 0.0, 1.0]
    for alpha, left in (([30.0, 0.0, 0.0], 0.0), ([0.0, -50.0, 0.0], 0.0), ([0.0, 0.0, 10.0], 0.05)):
        values = readings(np.array(alpha))
        apart = mix @ np.array([values[i] - values[j] for i, j, _ in PAIRS])
        assert abs(abs(apart[1]) - left) < 1e-3  # about its own axis: 5 mm of lever are left
    made = ScanCheck(PlausibilityLimits(), LSB_V, range(8), LABELS, mix=mix)
    frame, rng, first = LAYOUT.new_frame(), np.random.default_rng(6), None
    for k in range(3030):
        turning = 3.0 * np.sin(2 * np.pi * 9.7 * k * 1e-3) * np.array([1.0, -1.0, 0.0])
        frame[ACCELEROMETER : ACCELEROMETER + 6] = readings(turning) + 0.005 * rng.standard_normal(6)
        frame[ACCELEROMETER + 1] += 0.0098 * max(0, k - 3000)  # 1 V/s
        assert made.pairs(frame) == ""
        if first is None and (told := made.odd()):
            first = k
            assert told == "1z and 2z came apart along z"
    assert first is not None
    assert 3005 <= first <= 3015


def test_two_long_pairs_along_one_line_tell_nothing_of_the_short_one():
    places = np.zeros((6, 3))
    places[0] = places[2] = [0.0, 0.0, 0.1]
    places[1] = [0.02, 0.0, 0.0]
    axes = np.array([[1.0, 0, 0], [0, 0, 1.0], [1.0, 0, 0], [0, 0, 1.0], [1.0, 0, 0], [1.0, 0, 0]])
    assert turns_of_pairs(places, axes).tolist() == np.eye(3).tolist()


def test_kernel_and_python_agree():
    rows = scans(300)
    rows[50, 2] += 2000
    rows[200:, 5] = rows[200, 5]
    results, counted = [], []
    for function, view in ((check_counts, np.asarray), (check_counts.py_func, attributes)):  # type: ignore[attr-defined]
        memory = ScanCheck(PlausibilityLimits(), 5.0 / 32768, range(8), [""] * 8).memory
        state, params = view(memory.state)[0], view(memory.params)[0]
        found = []
        for k, row in enumerate(rows):
            state["counts"] = row
            found.append(function(k, state, params))
        results.append(found)
        counted.append(state["odd"].tolist())
    assert results[0] == results[1]
    assert counted[0] == counted[1]
    assert {value for value in results[0] if value} == {16 * 2 + 2, 16 * 5 + 3}
