"""Inspection of recordings against signals whose content is known."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.command import micron
from tools.research.tremor.inspect import Rule, inspect
from tools.research.tremor.signal import TremorSignal
from tools.research.tremor.signals import load_signals
from tools.research.tremor.spectrum import line_spread_hz, periodogram

RATE_HZ = 100.0


def made(values: np.ndarray, quantity: str = "acceleration", unit: str = "m/s^2") -> TremorSignal:
    return TremorSignal("made", "made", "nobody", quantity, unit, ("x",), values, RATE_HZ, RATE_HZ)


def walk(rng: np.random.Generator, n: int) -> np.ndarray:
    """Motion without a line: white noise through a 1.5 Hz low-pass of first order."""
    from scipy.signal import lfilter

    return np.asarray(lfilter([0.09], [1.0, -0.91], rng.standard_normal((n, 1)), axis=0))


def test_tone_amplitude_excursion_and_harmonic() -> None:
    t_s = np.arange(2400) / RATE_HZ
    wave = 2.0 * np.sin(2 * np.pi * 8.3 * t_s) + 0.5 * np.sin(2 * np.pi * 16.6 * t_s + 1.0)
    noise = 0.01 * np.random.default_rng(1).standard_normal(2400)
    found = inspect(made((wave + noise)[:, None]))
    assert found.peak_hz == pytest.approx(8.3, abs=0.002)
    assert found.low_hz <= 8.3 <= found.high_hz
    assert found.amplitude == pytest.approx(2.0, rel=0.01)
    assert found.excursion == pytest.approx(2.0 / (2 * np.pi * 8.3) ** 2, rel=0.01)
    assert found.excursion_unit == "m"
    assert found.harmonics[0] == pytest.approx(0.25, rel=0.03)
    assert found.tremor_share == 1.0


def test_windows_with_and_without_tremor() -> None:
    rng = np.random.default_rng(3)
    values = 0.5 * walk(rng, 8000)
    t_s = np.arange(8000) / RATE_HZ
    on = (t_s >= 20.0) & (t_s < 44.0)
    values[:, 0] += np.where(on, 0.25 * np.sin(2 * np.pi * 5.2 * t_s), 0.0)
    found = inspect(made(values, "angular rate", "rad/s"))
    assert [w.tremor for w in found.windows] == [5 <= i < 11 for i in range(20)]
    assert found.peak_hz == pytest.approx(5.2, abs=0.05)


def test_no_tremor_in_motion_without_a_line() -> None:
    rng = np.random.default_rng(4)
    found = inspect(made(walk(rng, 40_000)))
    assert found.tremor_share <= 0.02


def test_a_still_record_has_no_tremor_and_no_failure() -> None:
    found = inspect(made(np.zeros((1000, 1))))
    assert found.tremor_share == 0.0


def test_interval_of_a_window_covers_as_stated() -> None:
    rng = np.random.default_rng(5)
    t_s = np.arange(400) / RATE_HZ
    hits = errors = spread = 0.0
    for _ in range(120):
        f = rng.uniform(5.0, 10.0)
        wave = np.sin(2 * np.pi * f * t_s + rng.uniform(0, 6.3))[:, None] + 0.7 * rng.standard_normal((400, 1))
        (window,) = inspect(made(wave)).windows
        hits += window.low_hz <= f <= window.high_hz
        errors += (window.peak_hz - f) ** 2
        spread += line_spread_hz(periodogram(wave, RATE_HZ), f, 0.75, 1, RATE_HZ) ** 2
    assert 0.89 <= hits / 120 <= 0.99
    assert errors / spread == pytest.approx(1.0, abs=0.3)


def test_shaker_within_a_tenth_of_a_hertz(shared_data: Path) -> None:
    for s in load_signals(shared_data / "tremor_duke_adxl345"):
        if s.reference.amplitude in ("med", "high"):
            assert s.reference.drive_hz is not None
            assert inspect(s, Rule(band_hz=(1.5, 15.0))).peak_hz == pytest.approx(s.reference.drive_hz, abs=0.1)


def test_command_writes_json_picture_and_page(tmp_path: Path) -> None:
    t_s = np.arange(1200) / RATE_HZ
    file = tmp_path / "hand.csv"
    file.write_text("t_s,x_um\n" + "\n".join(f"{t:.3f},{20 * np.sin(2 * np.pi * 9 * t):.4f}" for t in t_s))
    out = {kind: tmp_path / f"found.{kind}" for kind in ("json", "png", "html")}
    command = ["tremor", "inspect", str(file), "--json", str(out["json"]), "--png", str(out["png"])]
    result = micron(*command, "--html", out["html"])
    assert result.exit_code == 0, result.output
    (signal,) = json.loads(out["json"].read_text())["signals"]
    assert signal["peak_hz"] == pytest.approx(9.0, abs=0.01)
    assert signal["excursion"] == pytest.approx(20e-6, rel=0.01)
    assert out["png"].read_bytes().startswith(b"\x89PNG")
    assert "data:image/png" in out["html"].read_text()


@pytest.mark.parametrize("extra", [["--low-hz", "9", "--high-hz", "9.5"], ["--png", "nowhere/x.png"]])
def test_command_refuses_bad_input(tmp_path: Path, extra: list[str]) -> None:
    file = tmp_path / "hand.csv"
    file.write_text("t_s,x_um\n" + "\n".join(f"{i / 100},{i % 7}" for i in range(900)))
    result = micron("tremor", "inspect", file, *extra)
    assert result.exit_code == 2, result.output
