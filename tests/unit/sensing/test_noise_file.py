"""From a recording at rest through ``micron noise --json`` to the covariances of the attitude filter."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_py.control.plan import load_plan
from firmware_py.frame import AXES
from firmware_py.sensing.attitude_params import alpha_drift_densities, error_state_params, motion_densities
from firmware_py.sensing.config import SensingConfig
from firmware_py.sensing.kinematics import observation_matrix
from firmware_py.sensing.noise_file import noise_table
from hal.bench import load_bench
from hal.errors import BenchError
from tests.command import micron

BENCH = Path(__file__).parents[3] / "benches" / "micron.toml"
NAMES = [f"accelerometer_{axis}" for axis in AXES]
RATE_HZ = 100.0


def model(white: float, flicker: float = 0.0, walk: float = 0.0, ramp: float = 0.0) -> dict[str, Any]:
    values = {"white": white, "flicker": flicker, "walk": walk, "ramp": ramp}
    return {"model": {name: {"value": value, "low": 0.0, "high": 1.0} for name, value in values.items()}}


def noise_json(**change: Any) -> dict[str, Any]:
    columns = {name: model(1e-3 * (i + 1), walk=1e-4) for i, name in enumerate(NAMES)}
    return {"format": 1, "rate_hz": RATE_HZ, "scale": 1.0, "shortest_s": 0.1, "columns": columns} | change


def write(path: Path, content: Any) -> Path:
    path.write_text(json.dumps(content))
    return path


def bench_with(folder: Path, noise: Path) -> Path:
    text = BENCH.read_text().replace("calibration/", f"{BENCH.parent}/calibration/")
    path = folder / "bench.toml"
    path.write_text(text.replace("[firmware]\n", f'[firmware]\nnoise = "{noise}"\n', 1))
    return path


def test_white_noise_is_a_density_and_a_random_walk_a_drift(tmp_path: Path) -> None:
    table = noise_table(write(tmp_path / "n.json", noise_json()), SensingConfig())
    # N is the root of the two-sided density: sqrt 2 below the data sheet's one-sided figure
    np.testing.assert_allclose(table["noise_ug_per_rtHz"], np.arange(1, 7) * np.sqrt(2.0) * 1e3 / 9.80665, rtol=1e-12)
    np.testing.assert_allclose(table["axis_drift_m_s2"], 1e-3, rtol=1e-12)  # 1e-4 sqrt(100 s)
    assert "magnetometer_noise_uT" not in table


def test_the_filter_gets_what_was_measured(tmp_path: Path) -> None:
    config = SensingConfig.model_validate(noise_table(write(tmp_path / "n.json", noise_json()), SensingConfig()))
    h = observation_matrix(config.axis_positions(), np.array(config.axes))
    white = np.diag((np.arange(1, 7) * 1e-3) ** 2)
    inverse = np.linalg.inv(h)  # six axes: no weights are left to choose
    np.testing.assert_allclose(motion_densities(config), inverse @ white @ inverse.T, rtol=1e-9)
    drift = np.diag(inverse[3:] @ inverse[3:].T) * 1e-8 + config.alpha_drift_rad_s2**2 / 100.0
    np.testing.assert_allclose(alpha_drift_densities(config), drift, rtol=1e-9)
    np.testing.assert_allclose(error_state_params(config)["bias_density"][0], drift, rtol=1e-9)


def test_from_a_recording_at_rest_to_the_firmware(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    n = np.linspace(5e-4, 1e-3, 6)  # m/s^2 sqrt s
    columns = dict(zip(NAMES, (n[:, None] * np.sqrt(RATE_HZ) * rng.standard_normal((6, 20_000))), strict=True))
    columns |= {f"magnetometer_{a}": 7e-4 * np.sqrt(RATE_HZ) * rng.standard_normal(20_000) for a in "xyz"}
    np.savez(tmp_path / "rest.npz", **columns)
    arguments = ["noise", str(tmp_path / "rest.npz"), "--rate-hz", "100", "--shortest-s", "0.1"]
    arguments += ["--json", str(tmp_path / "noise.json"), "--picture", str(tmp_path / "noise.png")]
    result = micron(*arguments)
    assert result.exit_code == 0, result.output
    sensing = load_plan(load_bench(bench_with(tmp_path, tmp_path / "noise.json"))).stages.sensing
    np.testing.assert_allclose(sensing.noise_ug_per_rtHz, n * np.sqrt(2.0) * 1e6 / 9.80665, rtol=0.05)
    assert sensing.magnetometer_noise_uT == pytest.approx(7e-4, rel=0.05)
    # what came from the bench and its calibration stays
    assert sensing.bias_V == load_plan(load_bench(BENCH)).stages.sensing.bias_V


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "not the JSON"),
        (json.dumps({"format": 1}), "scale"),
        (json.dumps(noise_json(shortest_s=0.0)), "--shortest-s 0.1"),
        (json.dumps(noise_json(scale=2.0)), "scale = 1"),
        (json.dumps(noise_json(columns={"gyro_x": model(1.0)})), "accelerometer_1x"),
        (json.dumps(noise_json(columns={NAMES[0]: model(-1.0)})), "white.value"),
    ],
)
def test_a_bad_file_is_refused(tmp_path: Path, content: str, message: str) -> None:
    path = tmp_path / "n.json"
    path.write_text(content)
    with pytest.raises(BenchError, match=message):
        noise_table(path, SensingConfig())


def test_a_bench_with_a_bad_noise_file_ends_with_2(tmp_path: Path) -> None:
    bench = bench_with(tmp_path, tmp_path / "absent.json")
    np.savez(tmp_path / "rest.npz", **{f"analog_V_{i}": np.zeros(9) for i in range(8)})
    result = micron("noise", tmp_path / "rest.npz", "--bench", bench)
    assert result.exit_code == 2
    assert "absent.json" in result.output
