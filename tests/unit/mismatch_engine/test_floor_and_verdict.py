"""The noise floor as an interval, verdicts that hold over it, and what an unexplained residual means.

Recordings are integrated here, with sensors of their own: behind a low-pass, smoothed, with a period, with rests.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import lfilter

from tests.unit.mismatch_engine.cases import RATE, recording, wave
from tests.unit.mismatch_report.canned import creep
from tools.mismatch.engine.assemble import summary
from tools.mismatch.engine.dependence import Dependence
from tools.mismatch.engine.noise import NoiseFloor, floor_interval, noise_floor, repeat_floor, rest_floor, without_lines
from tools.mismatch.engine.pose import prepared
from tools.mismatch.engine.unexplained import Leftover
from tools.mismatch.engine.verdict import Decision, fit_trouble, meaning_of
from tools.mismatch.engine.windows import bad_windows
from tools.mismatch.infer import diagnose
from tools.mismatch.recording import Recording
from tools.mismatch.recording_load import load

Array = np.ndarray
N = 4000
NOISE_UM = 0.05


def filtered_noise(rng: np.random.Generator, n: int) -> Array:
    """Unit noise of a sensor with a second-order low-pass at a fortieth of the rate: smooth from sample to sample."""
    e = rng.standard_normal(n + 500)
    for _ in range(2):
        e = np.asarray(lfilter([0.15], [1.0, -0.85], e))
    return e[500:] / e.std()


def stack(rng: np.random.Generator, u: Array, added: Array | float = 0.0, **more: object) -> Recording:
    """A stack of gain 0.12 um/V behind a sensor with filtered noise; the twin is right but for what is ``added``."""
    y = 1.0 + 0.12 * u + added + NOISE_UM * filtered_noise(rng, u.size)
    made = recording("piezo_stack", {"command": u}, {"displacement": y}, {"gain_um_per_V": 0.12, "offset_um": 1.0})
    return replace(made, **more)


def periodic(n: int, samples: int = 500) -> Array:
    t = np.arange(n) / samples
    return 50 + 25 * np.sin(2 * np.pi * t) + 12 * np.sin(2 * np.pi * 3 * t + 1)


@pytest.mark.parametrize("seed", range(3))
def test_periods_see_the_noise_of_a_filtered_sensor_whole(seed: int) -> None:
    rng = np.random.default_rng([seed, 1])
    u = periodic(6000)
    loop = np.abs(u - 50)  # physics that no twin has: the same in every period
    y = 0.12 * u + loop + NOISE_UM * filtered_noise(rng, u.size)
    found = repeat_floor(y, u[:, None])
    assert found is not None
    assert found[0] == pytest.approx(NOISE_UM, rel=0.15)
    floor = noise_floor(y, y - 0.12 * u, RATE, inputs=u[:, None])
    assert floor.method == "repeats"
    assert floor.rms == pytest.approx(NOISE_UM, rel=0.15)


def test_the_first_period_of_three_starts_elsewhere_and_is_left_out() -> None:
    rng = np.random.default_rng(2)
    u = periodic(2500)
    start = 5 * np.exp(-np.arange(2500) / 60)
    found = repeat_floor(u + start + NOISE_UM * rng.standard_normal(2500), u[:, None])
    assert found is not None
    assert found[0] == pytest.approx(NOISE_UM, rel=0.1)


def test_a_walk_between_periods_is_not_booked_as_noise() -> None:
    rng = np.random.default_rng(3)
    u = periodic(6000)
    y = 0.12 * u + 0.01 * np.cumsum(rng.standard_normal(6000)) + 0.02 * rng.standard_normal(6000)
    floor = noise_floor(y, y - 0.12 * u, RATE, inputs=u[:, None])
    assert floor.rms < 0.03


@pytest.mark.parametrize("seed", range(3))
def test_stretches_at_rest_see_it_too(seed: int) -> None:
    rng = np.random.default_rng([seed, 4])
    u = np.repeat(rng.uniform(10, 90, 10), 400)
    y = 0.12 * np.asarray(lfilter([0.05], [1.0, -0.95], u)) + NOISE_UM * filtered_noise(rng, u.size)
    found = rest_floor(y, u[:, None])
    assert found is not None
    assert found[0] == pytest.approx(NOISE_UM, rel=0.25)
    assert rest_floor(y, 50 + 40 * wave(rng, u.size)[:, None]) is None


def test_mains_at_rest_is_a_line_and_no_noise() -> None:
    """Hum of ten times the noise, in three short stretches at rest; slow coloured noise has no line."""
    rng = np.random.default_rng(5)
    u = 50.0 + 40.0 * wave(rng, 3000)
    rest = np.zeros(u.size, np.bool_)
    for a in (300, 1200, 2300):
        rest[a : a + 130] = True
        u[a : a + 130] = u[a]
    quiet = 0.01 * rng.standard_normal(u.size)
    hum = 0.14 * np.sin(2 * np.pi * 0.2503 * np.arange(u.size) + 0.4)
    found = rest_floor(quiet + hum, u[:, None])
    assert found is not None
    assert found[0] == pytest.approx(0.01, rel=0.3)
    slow = np.asarray(lfilter([1.0], [1.0, -0.95], quiet))
    assert without_lines(np.where(rest, slow, 0.0), rest) == pytest.approx(np.where(rest, slow, 0.0))


def test_an_output_that_still_rings_at_rest_is_no_noise() -> None:
    """A lightly damped stage between steps: what a free run of the right twin leaves bounds the noise."""
    rng, dt, noise = np.random.default_rng(14), 1 / RATE, 2e-3
    u = np.repeat(rng.uniform(-1.0, 1.0, N // 200), 200)
    a = np.array([[0.0, 1.0], [-(300.0**2), -2 * 0.02 * 300.0]])
    step = expm(np.block([[a, np.array([[0.0], [300.0**2]])], [np.zeros((1, 3))]]) * dt)
    x, y = np.zeros(2), np.empty(N)
    for k in range(N):
        y[k] = x[0]
        x = step[:2, :2] @ x + step[:2, 2] * u[k]
    believed = {"A": a.tolist(), "B": [[0.0], [300.0**2]], "C": [[1.0, 0.0]], "hold": "zero"}
    rec = recording("state_space", {"command": u}, {"displacement": y + noise * rng.standard_normal(N)}, believed)
    problem, raw, _ = prepared(rec, 0.3, 0, False)
    loud = replace(problem.floors["displacement"], rms=30 * noise, method="rest")
    quieter = problem.with_floors({"displacement": loud}).quieter(raw.residual)
    assert quieter.sigma("displacement") == pytest.approx(noise, rel=0.1)
    assert quieter.quieter({"displacement": 2 * raw.residual["displacement"]}) is quieter


def test_a_declared_resolution_is_the_least_noise() -> None:
    smooth = np.sin(np.arange(N) / 50)
    assert noise_floor(smooth, 1e-9 * smooth, RATE, resolution=0.01).rms == pytest.approx(0.01 / np.sqrt(12))


def test_a_smooth_record_has_an_interval_whose_upper_end_is_what_nothing_predicts() -> None:
    rng = np.random.default_rng(5)
    e = NOISE_UM * filtered_noise(rng, N)
    floor = noise_floor(e, e, RATE)
    lo, hi = floor_interval(floor, e, 0.0, RATE)
    assert lo < 0.5 * NOISE_UM
    assert hi == pytest.approx(float(e.std()), rel=0.02)
    assert floor_interval(floor, e, 0.75, RATE)[1] == pytest.approx(0.5 * float(e.std()), rel=0.02)
    declared = NoiseFloor(0.3, 0.01, 0.3, 0.0, "declared", True, 0.3)
    assert floor_interval(declared, e, 0.0, RATE) == (0.3, 0.3)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)])
def test_a_right_twin_behind_a_filtered_sensor_is_not_unexplained(seed: int) -> None:
    rng = np.random.default_rng([seed, 6])
    report = diagnose(stack(rng, 50 + 40 * wave(rng, N)), jobs=1)
    assert report.verdict in ("agrees", "recalibrate")
    lo, hi = report.fit.noise_floor_interval["displacement"]
    assert lo <= NOISE_UM <= 1.1 * hi


def test_differences_below_the_tolerance_do_not_matter() -> None:
    rng = np.random.default_rng(7)
    u = 50 + 40 * wave(rng, N)
    bend = 0.3 * ((u - 50) / 40) ** 2
    matters = diagnose(stack(rng, u, bend, noise={"displacement": NOISE_UM}), jobs=1)
    assert matters.verdict in ("missing_physics", "unexplained")
    made = stack(rng, u, bend, noise={"displacement": NOISE_UM}, tolerance={"displacement": 1.0})
    report = diagnose(made, jobs=1)
    assert report.verdict == "agrees"
    assert report.physics == ()
    assert "tolerance" in report.summary
    assert report.fit.tolerance == {"displacement": 1.0}


def test_a_law_inside_an_opaque_twin_is_out_of_reach_and_the_report_says_so() -> None:
    rng = np.random.default_rng(8)
    problem, _, _ = prepared(stack(rng, 50 + 40 * wave(rng, N)), 0.3, 0, False)
    follows = (Dependence("command", "rate", 1e-9, 0.4, False),)
    left = {"displacement": Leftover("displacement", 9.0, follows, 1.0, True)}
    assert meaning_of(problem, left, ()) == "unknown"
    assert meaning_of(problem, left, ("worse",)) == "fit_failed"
    twin: Any = problem.twin
    outside = replace(problem, twin=replace(twin, static=False))
    assert meaning_of(outside, left, ()) == "place_not_reachable"


def test_a_fit_that_is_worse_than_the_belief_is_called_a_failed_fit() -> None:
    rng = np.random.default_rng(9)
    problem, raw, base = prepared(stack(rng, 50 + 40 * wave(rng, N)), 0.3, 0, False)
    assert fit_trouble(problem, raw, base, base) == ()
    spoiled = replace(base, residual={o: 8.0 * r + 1.0 for o, r in base.residual.items()})
    assert "worse" in fit_trouble(problem, raw, spoiled, spoiled)[0]
    away = replace(base, residual={o: r + 1e6 for o, r in base.residual.items()})
    assert "runs away" in fit_trouble(problem, raw, away, away)[0]


def test_an_unexplained_rest_does_not_hide_what_a_name_explains() -> None:
    rng = np.random.default_rng(11)
    problem, _, base = prepared(stack(rng, 50 + 40 * wave(rng, N)), 0.3, 0, False)
    fitted = replace(base, residual={o: 0.25 * r for o, r in base.residual.items()})
    decision = Decision("unexplained", 1e-9, "unknown", (), {"displacement": (0.001, 0.001)})
    told = [summary(decision, names, ["displacement"], [], problem, (base, fitted)) for names in ([], [creep()])]
    assert told[0] == "Something is left in displacement that no known effect explains."
    found = re.fullmatch(
        re.escape(told[0]) + r" With creep the held-out residual falls from (\S+) to (\S+) \w+\.", told[1]
    )
    assert found is not None, told[1]
    before, after = found.groups()
    assert float(after) == pytest.approx(0.25 * float(before), rel=0.01)


def test_windows_are_spans_even_where_all_of_the_record_is_above_the_noise() -> None:
    rng = np.random.default_rng(10)
    e = rng.standard_normal(N)
    e[1000:1600] *= 6.0
    spans = bad_windows(e, 0.01, 1.0)
    covered = sum(b - a for a, b in spans)
    assert covered < 0.5 * N
    assert any(a < 1100 and b > 1500 for a, b in spans)
    # what is as loud throughout is everywhere, and that is said
    assert bad_windows(rng.standard_normal(N) * np.ones(N), 0.01, 1.0) != []


def test_a_tolerance_is_in_the_unit_of_its_channel(tmp_path: Path) -> None:
    rng = np.random.default_rng(11)
    u = 50 + 40 * wave(rng, 400)
    np.savez(tmp_path / "data.npz", u=u, y=(1 + 0.12 * u) * 1e3)
    text = (
        'format = 1\ndata = "data.npz"\nrate_hz = 500.0\n[twin]\nkind = "piezo_stack"\n'
        '[[channels]]\ncolumn = "u"\nrole = "input"\nsignal = "command"\nunit = "V"\n'
        '[[channels]]\ncolumn = "y"\nrole = "output"\nsignal = "displacement"\nunit = "nm"\ntolerance = 50.0\n'
    )
    (tmp_path / "recording.toml").write_text(text)
    assert load(tmp_path).tolerance == {"displacement": pytest.approx(0.05)}
