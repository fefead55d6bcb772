"""Figures of a run against signals whose answer is known."""

import numpy as np
import pytest

from tools.reports.figures import SHOWN_HZ, SPECTRUM_HZ, spectrum_of, tremor_figures

RATE_HZ = 1000.0


def truth(attenuation: float = 0.25, delay_s: float = 0.0, seconds: float = 12.0) -> dict[str, np.ndarray]:
    """A 10 Hz tremor of 20, 10, 5 um amplitude on a 0.3 Hz path; compensation leaves ``attenuation`` of it."""
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    tremor = 1e-6 * np.outer(np.sin(2 * np.pi * 10 * t), (20.0, 10.0, 5.0))
    path = 1e-6 * np.outer(np.sin(2 * np.pi * 0.3 * t), (300.0, 200.0, 100.0))
    late = 1e-6 * np.outer(np.sin(2 * np.pi * 0.3 * (t - delay_s)), (300.0, 200.0, 100.0))
    return {
        "t_ns": (t * 1e9).astype(np.int64),
        "tip_rigid_m": path + tremor,
        "tip_m": late + attenuation * tremor,
        "intended_m": path,
    }


def test_reduction_per_axis_and_vector():
    figures = tremor_figures(truth(), from_ns=2_000_000_000, to_ns=11_500_000_000)
    assert figures is not None
    assert figures.vector.uncompensated_rms_um == pytest.approx(np.sqrt((400 + 100 + 25) / 2), rel=0.01)
    assert figures.vector.reduction_percent == pytest.approx(75.0, abs=0.1)
    assert figures.per_axis["y"].uncompensated_rms_um == pytest.approx(10 / np.sqrt(2), rel=0.01)
    assert figures.whole_band.compensated_rms_um == pytest.approx(0.25 * np.sqrt(525 / 2), rel=0.01)


def test_amplified_tremor_is_a_negative_reduction():
    figures = tremor_figures(truth(attenuation=1.5), from_ns=2_000_000_000, to_ns=11_500_000_000)
    assert figures is not None
    assert figures.vector.reduction_percent == pytest.approx(-50.0, abs=0.2)


def test_voluntary_gain_and_delay():
    figures = tremor_figures(truth(delay_s=0.012), from_ns=2_000_000_000, to_ns=11_500_000_000)
    assert figures is not None
    assert figures.voluntary_gain == pytest.approx(1.0, abs=0.005)
    assert figures.voluntary_delay_ms == pytest.approx(12.0, abs=0.5)


def test_what_came_before_settling_does_not_count():
    data = truth()
    data["tip_m"][:1500] += 1e-3
    figures = tremor_figures(data, from_ns=2_000_000_000, to_ns=11_500_000_000)
    assert figures is not None
    assert figures.evaluated_s[0] >= 2.0
    assert figures.vector.reduction_percent == pytest.approx(75.0, abs=1.0)


def test_too_short_to_say():
    assert tremor_figures(truth(), from_ns=2_000_000_000, to_ns=2_900_000_000) is None


def test_what_comes_after_the_run_does_not_count():
    data = truth()
    data["tip_m"][9000:] += 1e-3
    figures = tremor_figures(data, from_ns=2_000_000_000, to_ns=8_000_000_000)
    assert figures is not None
    assert figures.vector.reduction_percent == pytest.approx(75.0, abs=1.0)


def test_the_spectrum_of_white_noise_is_flat_and_a_line_stands_where_it_is():
    rng = np.random.default_rng(4)
    noise = 1e-6 * rng.standard_normal((60_000, 3))
    found = spectrum_of(noise, np.zeros_like(noise), rate_hz=RATE_HZ)
    assert found.hz == tuple(float(hz) for hz in SPECTRUM_HZ)
    # three axes of 1 um rms up to 500 Hz
    assert np.median(found.without_um_rtHz) == pytest.approx(np.sqrt(3.0 / 500.0), rel=0.05)
    assert max(found.with_um_rtHz) == 0.0
    assert set(SHOWN_HZ) <= set(found.hz)
    data = truth()
    figures = tremor_figures(data, from_ns=2_000_000_000, to_ns=11_500_000_000)
    assert figures is not None
    spectrum = figures.spectrum
    assert spectrum.hz[int(np.argmax(spectrum.without_um_rtHz))] == 10.0
    at = spectrum.hz.index(10.0)
    assert spectrum.with_um_rtHz[at] == pytest.approx(0.25 * spectrum.without_um_rtHz[at], rel=0.01)
    octave = 10.0 * (2 ** (1 / 6) - 2 ** (-1 / 6))
    assert spectrum.without_um_rtHz[at] == pytest.approx(np.sqrt(525 / 2 / octave), rel=0.1)


def test_a_short_run_has_a_value_in_every_third_octave():
    t = np.arange(1000) / RATE_HZ
    error = 1e-6 * np.sin(2 * np.pi * 8.0 * t)[:, None]
    found = spectrum_of(error, error, rate_hz=RATE_HZ)
    assert all(np.isfinite(found.without_um_rtHz))
