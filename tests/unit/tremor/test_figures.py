"""Figures of a run against signals whose answer is known."""

import numpy as np
import pytest

from tools.reports.figures import tremor_figures

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
