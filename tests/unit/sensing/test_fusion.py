"""Attitude filters with a gyroscope against closed forms, finite differences and published errors."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path

import numpy as np
import pytest

from firmware_py.records import attributes, new
from firmware_py.sensing.fusion import Fusion, FusionConfig, angles_deg
from firmware_py.sensing.quaternion import from_matrix
from hal.arrays import Array
from tools.research.endoscope import published_filters
from tools.research.reproduce.broad_trials import read_trial
from tools.research.reproduce.gyroscope_attitude import gyroscope_attitude

RATE_HZ = 100.0
FILTERS = ["tilt", "gyroscope", "complementary", "madgwick", "mahony"]


def gravity(roll_deg: float, pitch_deg: float) -> Array:
    """Specific force at rest, (3.10): R^T (0, 0, g)."""
    r, p = math.radians(roll_deg), math.radians(pitch_deg)
    return 9.80665 * np.array([-math.sin(p), math.sin(r) * math.cos(p), math.cos(r) * math.cos(p)])


def still(n: int, roll_deg: float, pitch_deg: float = 0.0) -> tuple[Array, Array]:
    return np.zeros((n, 3)), np.tile(gravity(roll_deg, pitch_deg), (n, 1))


@pytest.mark.parametrize("method", [*FILTERS, "error-state", "vqf"])
def test_starts_from_the_mean_of_the_first_tenth_of_a_second(method: str) -> None:
    fusion = Fusion(FusionConfig(method=method), RATE_HZ)
    rate, force = still(200, 30.0, -20.0)
    q = fusion.run(rate, force)
    assert fusion.aligned
    assert angles_deg(q[-1])[:2] == pytest.approx((30.0, -20.0), abs=0.05)
    if method != "vqf":
        assert angles_deg(q[9]) == pytest.approx((30.0, -20.0, 0.0), abs=1e-9)


@pytest.mark.parametrize("method", [*FILTERS, "error-state"])
def test_live_and_batch_are_the_same_numbers(method: str) -> None:
    rng = np.random.default_rng(1)
    rate, force = rng.normal(0.0, 0.5, (60, 3)), gravity(10.0, 5.0) + rng.normal(0.0, 1.0, (60, 3))
    batch = Fusion(FusionConfig(method=method), RATE_HZ).run(rate, force)
    live = Fusion(FusionConfig(method=method), RATE_HZ)
    for k in range(60):
        assert np.array_equal(live.step(rate[k], force[k]), batch[k])


def test_gyroscope_alone_is_the_exact_turn() -> None:
    # a constant body rate: q = exp(w t / 2)
    n, w = 300, np.array([0.7, -1.1, 0.4])
    fusion = Fusion(FusionConfig(method="gyroscope", align_s=0.0), RATE_HZ)
    q = fusion.run(np.tile(w, (n, 1)), np.tile(gravity(0.0, 0.0), (n, 1)))
    half = 0.5 * np.linalg.norm(w) * n / RATE_HZ
    expected = np.array([math.cos(half), *(math.sin(half) * w / np.linalg.norm(w))])
    np.testing.assert_allclose(q[-1] * np.sign(q[-1, 0]), expected * np.sign(expected[0]), atol=1e-12)


@pytest.mark.parametrize("tau_s", [0.1, 0.2])
def test_complementary_filter_is_the_recursion_of_the_document(tau_s: float) -> None:
    # (3.28)-(3.30) about one axis, gyroscope with an offset
    n, offset = 40, 0.3
    fusion = Fusion(FusionConfig(method="complementary", tau_s=tau_s, align_s=0.0), RATE_HZ)
    q = fusion.run(np.tile([offset, 0.0, 0.0], (n, 1)), np.tile(gravity(43.87, 0.0), (n, 1)))
    a, psi = tau_s / (tau_s + 0.01), 0.0
    for k in range(n):
        psi = a * (psi + math.degrees(offset) * 0.01) + (1.0 - a) * 43.87
        assert angles_deg(q[k])[0] == pytest.approx(psi, abs=1e-9)


def test_complementary_filter_reaches_63_percent_after_tau() -> None:
    fusion = Fusion(FusionConfig(method="complementary", tau_s=0.2, align_s=0.0), 10_000.0)
    q = fusion.run(*still(2000, 45.0))
    # the implicit rule lags by half a sample: dt / (2 tau) of what is left
    assert angles_deg(q[-1])[0] == pytest.approx(45.0 * (1.0 - math.exp(-1.0) * (1.0 + 2.5e-4)), abs=1e-5)


def test_upside_down_is_left() -> None:
    fusion = Fusion(FusionConfig(method="complementary", align_s=0.0), RATE_HZ)
    q = fusion.run(*still(300, 180.0))
    assert abs(angles_deg(q[-1])[0]) == pytest.approx(180.0, abs=1e-3)


def test_mahony_takes_the_offset_of_the_gyroscope_out() -> None:
    # linear, about one axis: error e, integral i: e' = b - kp e - i, i' = ki e; so i -> b and e -> 0
    offset = 0.02
    fusion = Fusion(FusionConfig(method="mahony", kp=1.4, ki=0.5), RATE_HZ)
    n = 4000
    q = fusion.run(np.tile([offset, 0.0, 0.0], (n, 1)), np.tile(gravity(10.0, 0.0), (n, 1)))
    assert angles_deg(q[-1])[0] == pytest.approx(10.0, abs=1e-3)
    lazy = Fusion(FusionConfig(method="mahony", kp=1.4, ki=0.0), RATE_HZ)
    q = lazy.run(np.tile([offset, 0.0, 0.0], (n, 1)), np.tile(gravity(10.0, 0.0), (n, 1)))
    assert angles_deg(q[-1])[0] == pytest.approx(10.0 + math.degrees(math.asin(offset / 1.4)), abs=1e-3)


@pytest.mark.parametrize("with_field", [False, True])
def test_madgwick_steps_along_the_gradient(with_field: bool) -> None:
    """The step's direction against finite differences of half the squared residual (3.68)."""
    q0 = np.array([0.9, 0.2, -0.3, 0.1])
    q0 /= np.linalg.norm(q0)
    force, field = np.array([0.3, -0.4, 0.9]), np.array([0.5, 0.2, -0.7]) if with_field else np.full(3, np.nan)
    a, m = force / np.linalg.norm(force), field / np.linalg.norm(field)
    w, x, y, z = q0
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    h = matrix @ m
    bx, bz = math.hypot(h[0], h[1]), h[2]

    def cost(q: Array) -> float:
        w, x, y, z = q
        f = np.array([2 * (x * z - w * y), 2 * (w * x + y * z), 1 - 2 * (x * x + y * y)]) - a
        total = 0.5 * f @ f
        if with_field:
            g = np.array(
                [
                    2 * bx * (0.5 - y * y - z * z) + 2 * bz * (x * z - w * y),
                    2 * bx * (x * y - w * z) + 2 * bz * (w * x + y * z),
                    2 * bx * (w * y + x * z) + 2 * bz * (0.5 - x * x - y * y),
                ]
            )
            total += 0.5 * (g - m) @ (g - m)
        return float(total)

    eps = 1e-6
    slope = np.array([(cost(q0 + eps * e) - cost(q0 - eps * e)) / (2 * eps) for e in np.eye(4)])
    beta, dt_s = 0.1, 0.01
    fusion = Fusion(FusionConfig(method="madgwick", beta=beta), 1.0 / dt_s)
    fusion.restart(q0)
    after = fusion.step(np.zeros(3), force, field)
    expected = q0 - beta * dt_s * slope / np.linalg.norm(slope)
    np.testing.assert_allclose(after, expected / np.linalg.norm(expected), atol=1e-9)


@pytest.mark.parametrize("method", ["madgwick", "mahony"])
def test_a_magnetometer_holds_the_heading(method: str) -> None:
    north = np.array([20.0, 0.0, -45.0])
    config = FusionConfig(method=method, beta=0.2, kp=2.0)
    fusion = Fusion(config, RATE_HZ)
    half = math.radians(-30.0) / 2
    fusion.restart(np.array([math.cos(half), 0.0, 0.0, math.sin(half)]))
    n = 3000
    rate, force = still(n, 0.0)
    assert abs(angles_deg(fusion.run(rate, force, np.tile(north, (n, 1)))[-1])[2]) < 0.5


def test_the_error_state_filter_finds_the_bias_at_rest_without_a_magnetometer() -> None:
    bias = np.radians([0.4, -0.3, 0.5])
    fusion = Fusion(FusionConfig(method="error-state"), RATE_HZ)
    rate, force = still(6000, 20.0, 10.0)
    q = fusion.run(rate + bias, force)
    late = [angles_deg(q[k])[2] for k in (3000, 5999)]
    # half a degree a second, unseen by gravity, would be 15 degrees in the second half
    assert abs(late[1] - late[0]) < 0.1
    assert angles_deg(q[-1])[:2] == pytest.approx((20.0, 10.0), abs=0.1)


@pytest.mark.parametrize("method", FILTERS)
def test_free_fall_and_standstill_do_not_break_it(method: str) -> None:
    fusion = Fusion(FusionConfig(method=method, align_s=0.0), RATE_HZ)
    q = fusion.run(np.zeros((20, 3)), np.zeros((20, 3)))
    np.testing.assert_array_equal(q, np.tile([1.0, 0.0, 0.0, 0.0], (20, 1)))
    # exactly level: Madgwick's gradient is zero (erratum 107)
    q = fusion.run(*still(20, 0.0))
    np.testing.assert_allclose(q[-1], [1.0, 0.0, 0.0, 0.0], atol=1e-15)


def test_angles_round_trip() -> None:
    rng = np.random.default_rng(3)
    for _ in range(100):
        roll, pitch, yaw = rng.uniform((-179, -89, -179), (179, 89, 179))
        sx, sy, sz = np.sin(np.radians([roll, pitch, yaw]))
        cx, cy, cz = np.cos(np.radians([roll, pitch, yaw]))
        # (3.13)
        matrix = np.array(
            [
                [cy * cz, sx * sy * cz - cx * sz, cx * sy * cz + sx * sz],
                [cy * sz, sx * sy * sz + cx * cz, cx * sy * sz - sx * cz],
                [-sy, sx * cy, cx * cy],
            ]
        )
        q = np.zeros(4)
        from_matrix(matrix, q)
        assert angles_deg(q) == pytest.approx((roll, pitch, yaw), abs=1e-9)


@pytest.mark.parametrize("method", FILTERS)
def test_kernel_and_python_agree(method: str) -> None:
    rng = np.random.default_rng(4)
    n = 30
    rate, force, field = rng.normal(size=(n, 3)), rng.normal((0.0, 0.0, 9.8), 1.0, (n, 3)), rng.normal(size=(n, 3))
    field[::3] = np.nan
    config = FusionConfig(method=method)
    compiled = Fusion(config, RATE_HZ)
    out = compiled.run(rate, force, field)
    params = new(
        published_filters.FusionParams,
        method=FILTERS.index(method),
        tau_s=config.tau_s,
        beta=config.beta,
        field_scale=config.field_scale,
        kp=config.kp,
        ki=config.ki,
        align_samples=10,
    )
    state = new(published_filters.FusionState)
    s, p = attributes(state)[0], attributes(params)[0]
    published_filters.begin_fusion.py_func(s, p)
    for k in range(n):
        published_filters.step_fusion.py_func(
            published_filters.FusionSample(rate[k], force[k], field[k], 1.0 / RATE_HZ), s, p
        )
        np.testing.assert_allclose(s.quaternion, out[k], atol=1e-14)


def test_rows_must_match_and_rate_be_positive() -> None:
    with pytest.raises(ValueError, match="rows"):
        Fusion(FusionConfig(), RATE_HZ).run(np.zeros((5, 3)), np.zeros((4, 3)))
    with pytest.raises(ValueError, match="rate_hz"):
        Fusion(FusionConfig(), 0.0)


@pytest.mark.parametrize("trial", ["02", "07", "16", "25"])
def test_broad_errors_are_the_published_ones(shared_data: Path, trial: str) -> None:
    """Same parameters, same start, same error: the published figures have four decimals."""
    folder = shared_data / "broad"
    entry = next(f for f in tomllib.loads((folder / "meta.toml").read_text())["files"] if f["name"].startswith(trial))
    read = read_trial(folder / entry["name"], entry)
    rate, force, field = read.rate, read.force, read.field
    # the authors begin with the inverse of the first sample's attitude, heading turned by 180 degrees
    up, anti = force[0], np.cross(np.cross(force[0], -field[0]), force[0])
    start = np.zeros(4)
    columns = (anti, np.cross(up, anti), up)
    from_matrix(np.column_stack([v / np.linalg.norm(v) for v in columns]), start)
    for method, config in (
        ("madgwick", FusionConfig(method="madgwick", beta=0.12, field_scale=0.5)),
        ("mahony", FusionConfig(method="mahony", kp=0.74, ki=0.0012)),
    ):
        fusion = Fusion(config, 1.0 / 0.0035)
        fusion.restart(start)
        total, _, _ = read.errors_deg(fusion.run(rate, force, field))
        assert total == pytest.approx(entry[f"{method}_rmse_deg"], abs=5e-4)
    ours = Fusion(FusionConfig(method="error-state"), 1.0 / 0.0035).run(rate, force, field)
    assert read.errors_deg(ours)[0] < entry["madgwick_best_rmse_deg"]
    if trial == "02":
        q = gyroscope_attitude(rate, force, field, 1.0 / 0.0035, "madgwick")
        assert read.errors_deg(q)[0] < 3.0


def test_an_installed_wheel_says_where_a_published_filter_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("firmware_py.sensing.fusion.offered", lambda group: {})
    with pytest.raises(ValueError, match="'mahony' is a filter to compare with: only a source tree has it"):
        FusionConfig(method="mahony")
