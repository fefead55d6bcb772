"""A rest that grows louder with the motion is no noise, whatever its colour."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_engine.cases import recording, swung
from tools.mismatch.engine.assemble import if_noise
from tools.mismatch.engine.pose import prepared
from tools.mismatch.engine.verdict import Decision
from tools.mismatch.infer import diagnose
from tools.mismatch.infer.loudness import louder_with, rank_correlation

RATE_HZ = 200.0


def test_series_that_know_nothing_of_each_other_are_as_alike_as_their_p_value_says() -> None:
    rng = np.random.default_rng(7)
    for slowness in (0.0, 0.6, 0.9):
        pairs = lfilter([1.0], [1.0, -slowness], rng.standard_normal((500, 2, 192)))[:, :, 64:]
        share = float(np.mean([rank_correlation(a, b)[1] < 0.05 for a, b in pairs]))
        assert share == pytest.approx(0.05, abs=0.035)  # three standard errors, and slow series that are few


def test_a_series_is_wholly_like_itself_and_unlike_its_negative() -> None:
    a = np.random.default_rng(2).standard_normal(128)
    assert rank_correlation(a, np.exp(a))[0] == pytest.approx(1.0)
    assert rank_correlation(a, np.exp(a))[1] < 1e-12
    assert rank_correlation(a, -a)[1] > 0.999
    assert rank_correlation(np.ones(128), a) == (0.0, 1.0)


@pytest.mark.parametrize("sways", [True, False])
def test_a_stiffness_that_sways_is_no_noise_and_slow_noise_is(sways: bool) -> None:
    rng = np.random.default_rng(3)
    u = np.repeat(rng.uniform(-1.0, 1.0, 300), 20) * np.repeat(rng.uniform(0.2, 2.0, 10), 600)
    plain, other = swung(u, RATE_HZ), swung(u, RATE_HZ, sway=0.35)
    left = other - plain
    noise = lfilter([1.0, 0.0], [1.0, -1.9, 0.95], rng.standard_normal(u.size))  # rings like the plant
    y = other if sways else plain + noise * np.std(left) / np.std(noise)
    y = y + 0.02 * np.std(left) * rng.standard_normal(u.size)
    parameters = {"A": [[0.0, 1.0], [-900.0, -4.0]], "B": [[0.0], [1.0]], "C": [[1.0, 0.0]], "hold": "zero"}
    rec = recording("state_space", {"u": u}, {"x": y}, parameters, rate_hz=RATE_HZ)
    problem, _, base = prepared(rec, 0.3, 0, False)
    assert (louder_with(problem, base, "x") is not None) is sways
    report = diagnose(rec, jobs=1, effects=[EFFECTS[n] for n in ("dead_time", "first_order_lag")])
    assert report.physics == ()
    if sways:
        assert report.verdict == "unexplained"
        assert {d.feature for d in report.location.depends_on} == {"amplitude"}
    else:
        assert report.verdict in ("agrees", "recalibrate")
        # the line that people read first says what such a verdict rests on
        rests = Decision("agrees", 1.0, "", (), {"x": (0.2, 0.9)}, ("x",))
        said = " That holds if all of the 0.9 V that are left of x are noise; the spectrum vouches for 0.2."
        assert if_noise(rests, problem, {"x": 0.9}) == said
        assert if_noise(replace(rests, doubtful=()), problem, {"x": 0.9}) == ""
