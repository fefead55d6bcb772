"""The loader of tremor recordings, and what it finds out about clocks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hal.even_samples import stamp_share, steady_stamps
from tools.errors import InputError
from tools.research.tremor.clock import rate_from_known
from tools.research.tremor.signals import load_signals
from tools.research.tremor.spectrum import highest_line, periodogram


def wave(t_s: np.ndarray) -> np.ndarray:
    """(n, 2), some lines below 4 Hz."""
    return np.stack([np.sin(2 * np.pi * 3.3 * t_s), np.cos(2 * np.pi * 1.7 * t_s + 1.0)], axis=1)


def test_line_between_grid_points_and_power_of_a_sine() -> None:
    t_s = np.arange(1800) / 100.0
    found = periodogram(3.0 * np.sin(2 * np.pi * 8.123 * t_s)[:, None] + 5.0 + 0.4 * t_s[:, None], 100.0)
    assert highest_line(found, (2.0, 15.0)) == pytest.approx(8.123, abs=2e-4)
    assert found.power((7.0, 9.5)) == pytest.approx(4.5, rel=1e-3)


def test_a_slope_into_the_band_is_no_line() -> None:
    t_s = np.arange(1800) / 100.0
    assert np.isnan(highest_line(periodogram(np.sin(2 * np.pi * 1.0 * t_s)[:, None], 100.0), (1.02, 1.1)))


def test_rate_from_known_frequencies_with_two_drives_that_are_off() -> None:
    rate_hz, known = 101.9, np.linspace(2.0, 12.0, 20)
    seen = known / rate_hz * (1.0 + 1e-4 * np.cos(np.arange(20.0)))
    seen[[3, 12]] *= 1.02
    clock = rate_from_known(list(known), list(seen), 100.0)
    assert clock.rate_hz == pytest.approx(rate_hz, rel=2e-4)
    assert clock.stated_is_wrong
    assert "not the real rate" in clock.sentence()
    assert not rate_from_known(
        list(known), list(known / 100.0 * (1 + 1e-3 * np.cos(np.arange(20.0)))), 100.0
    ).stated_is_wrong


def test_interval_of_the_rate_covers_as_stated() -> None:
    rng = np.random.default_rng(5)
    known = np.linspace(2.0, 12.0, 24)
    hit = 0
    for _ in range(400):
        clock = rate_from_known(list(known), list(known / 101.0 * np.exp(0.004 * rng.standard_t(4, 24))), 100.0)
        hit += clock.low_hz <= 101.0 <= clock.high_hz
    assert 0.92 <= hit / 400 <= 0.995


def test_too_few_known_frequencies() -> None:
    with pytest.raises(ValueError, match="at least 6"):
        rate_from_known([1.0] * 5, [0.01] * 5, 100.0)


@pytest.mark.parametrize("true_stamps", [True, False])
def test_jittered_stamps_are_told_from_jittered_samples(true_stamps: bool) -> None:
    rng = np.random.default_rng(2)
    even_s = np.arange(6000) / 64.0
    stamps_s = np.sort(even_s + rng.uniform(0.0, 0.012, 6000))
    share = stamp_share(stamps_s, wave(stamps_s if true_stamps else even_s))
    assert share == pytest.approx(1.0 if true_stamps else 0.0, abs=0.1)


def test_steady_stamps_recover_an_even_clock() -> None:
    rng = np.random.default_rng(3)
    even_s = np.arange(3000) / 64.0
    steady = steady_stamps(even_s + rng.uniform(-0.006, 0.006, 3000))
    assert np.std(steady - even_s) < 0.001
    assert np.all(np.diff(steady) > 0.0)


def test_csv_with_late_stamps_becomes_even(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    even_s = np.arange(1000) / 64.0
    stamps_s = np.sort(even_s + rng.uniform(0.0, 0.012, 1000))
    file = tmp_path / "hand.csv"
    rows = [f"{t:.4f},{x:.6f},{y:.6f},junk" for t, (x, y) in zip(stamps_s, wave(even_s), strict=True)]
    file.write_text("t_s,gyro_x_deg_s,gyro_y_deg_s,comment\n" + "\n".join(rows))
    (signal,) = load_signals(f"{file}#2:12")
    assert signal.quantity == "angular rate"
    assert signal.rate_hz == pytest.approx(64.0, rel=2e-3)
    assert signal.values.shape == (round(10 * signal.rate_hz), 2)
    assert "taken as an even clock" in signal.notes[0]
    assert signal.t_s[0] == pytest.approx(signal.start_s)
    error = np.rad2deg(signal.values) - wave(signal.t_s - 0.006)
    assert np.sqrt(np.mean(error**2)) < 0.06


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("a.csv", "time,acc\n1,2\n", "no column ends in a unit"),
        ("a.csv", "x_um\n1\n2\n", "neither a column t_s"),
        ("a.txt", "", "recording folder"),
        ("a.csv", "t_s,x_um\n" + "".join(f"{i / 100},{i}\n" for i in range(100)), "at least 4 s"),
        ("a.csv", "t_s,x_um\n0,1\n2,1\n1,1\n", "runs backwards"),
    ],
)
def test_bad_recordings_are_named(tmp_path: Path, name: str, text: str, expected: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=expected):
        load_signals(tmp_path / name)


def test_no_such_file_and_bad_part(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        load_signals(tmp_path / "nothing.csv")
    with pytest.raises(InputError, match="start:stop"):
        load_signals(f"{tmp_path}#1:x")


def test_data_sets(shared_data: Path) -> None:
    duke = load_signals(shared_data / "tremor_duke_adxl345")
    assert len(duke) == 49
    assert all(s.stated_rate_hz == 100.0 and 101.5 < s.rate_hz < 102.2 for s in duke)
    assert sum(s.reference.drive_hz is not None for s in duke) == 44
    (wrist,) = load_signals(shared_data / "tremor_paradigma_pd")
    assert wrist.reference.windows is not None
    assert wrist.reference.windows.tremor.sum() == 15
    mouse = load_signals(shared_data / "tremor_mouse_lsm9ds1")
    assert len({s.subject for s in mouse}) == 6
    assert [s.name for s in mouse if s.reference.tremor and s.quantity == "angular rate"] == ["mouse/23/gyro"]
    with pytest.raises(InputError, match="no recording 'x'"):
        load_signals(f"{shared_data / 'tremor_duke_adxl345'}#x")
