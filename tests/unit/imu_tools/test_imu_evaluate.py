"""Offsets, stability, temperature and auto-calibration against made-up sensors, emulated chips and real recordings."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from firmware_py.endoscope.wiring import open_sensors
from hal.arrays import Array
from hal.bench import load_bench, open_bench
from hal.errors import BenchError
from tests.command import micron
from tools.cli.main import app
from tools.errors import InputError
from tools.imu.evaluate import evaluate_fall, evaluate_parts, evaluate_still, evaluate_turned
from tools.imu.live import auto_calibrate, record
from tools.imu.offsets import manual, moved, simple
from tools.imu.series import Scales, Series, join_series, load_series
from tools.imu.stability import stability
from tools.imu.thermal import thermal

RATE_HZ = 100.0


def still(seconds: float = 60.0, *, offset: float = 0.02, gyro: float = 1.5, noise: float = 0.003) -> Series:
    rng = np.random.default_rng(1)
    n = round(seconds * RATE_HZ)
    accel = np.array([offset, -offset, 1.0 + offset]) + noise * rng.standard_normal((n, 3))
    rate = np.array([gyro, 0.0, -gyro]) + 0.05 * rng.standard_normal((n, 3))
    return Series("made up", RATE_HZ, accel, rate, np.full(n, 25.0))


# -- offsets ----------------------------------------------------------------------------------------------


def test_simple_takes_one_g_off_the_vertical_axis_whichever_way_it_points() -> None:
    assert simple(still()) == pytest.approx([0.02, -0.02, 0.02], abs=2e-4)
    series = still()
    down = Series("", RATE_HZ, -series.accel_g[:, ::-1], None)
    assert simple(down) == pytest.approx([-0.02, 0.02, -0.02], abs=2e-4)


def test_manual_is_half_sum_and_half_difference_and_names_missing_poles() -> None:
    t = np.arange(0, 60, 1 / RATE_HZ)
    quiet = 2 * np.pi * t / 30.0
    zero = np.zeros_like(t)
    legs = [np.stack([np.sin(quiet), zero, np.cos(quiet)], 1), np.stack([zero, np.sin(quiet), np.cos(quiet)], 1)]
    truth = np.concatenate(legs)
    offset, scale = np.array([0.03, -0.05, 0.08]), np.array([1.01, 0.99, 1.02])
    rng = np.random.default_rng(2)
    found = manual(Series("", RATE_HZ, truth * scale + offset + 0.002 * rng.standard_normal(truth.shape), None))
    assert found.offset_g == pytest.approx(offset, abs=1.5e-3)
    assert found.scale == pytest.approx(scale, abs=1.5e-3)
    assert found.poles == ()
    half = manual(Series("", RATE_HZ, legs[0] * scale + offset, None))
    assert set(half.poles) == {"+y", "-y"}


def test_free_fall_from_a_made_up_drop() -> None:
    rate_hz, fall_s = 1000.0, 0.3
    rng = np.random.default_rng(3)
    accel = np.tile([0.0, 0.0, 1.0], (2000, 1))
    accel[800 : 800 + round(fall_s * rate_hz)] = 0.0
    accel[1100:1110, 2] = 8.0
    accel += np.array([0.01, -0.02, 0.03]) + 0.002 * rng.standard_normal(accel.shape)
    found = evaluate_fall(Series("", rate_hz, accel, None))
    assert found["fall_s"] == pytest.approx(fall_s, abs=2e-3)
    assert found["start_s"] == pytest.approx(0.8, abs=2e-3)
    assert list(found["offset_g"].values()) == pytest.approx([0.01, -0.02, 0.03], abs=5e-4)
    with pytest.raises(InputError, match="no free fall"):
        evaluate_fall(still())


def test_a_moved_sensor_is_noticed() -> None:
    series = still()
    assert moved(series) is None
    series.accel_g[3000:] += np.array([0.1, 0.0, 0.0])
    reason = moved(series)
    assert reason is not None
    assert "jump by 0.09" in reason or "jump by 0.1" in reason
    with pytest.raises(InputError, match="lie still"):
        evaluate_still(series)


# -- stability --------------------------------------------------------------------------------------------


def test_drift_is_sixty_times_the_offset_and_noise_the_rms() -> None:
    series = still(gyro=2.0)
    found = stability(series, np.zeros(3), np.array([1.99, 0.0, -2.0]))
    assert found.drift_before_deg_min is not None
    assert found.drift_after_deg_min is not None
    assert found.noise_dps is not None
    assert found.drift_before_deg_min == pytest.approx([120.0, 0.0, -120.0], abs=0.2)
    assert found.drift_after_deg_min == pytest.approx([0.6, 0.0, 0.0], abs=0.2)
    assert found.noise_dps == pytest.approx([0.051, 0.05, 0.05], rel=0.03)


# -- temperature ------------------------------------------------------------------------------------------


def warm(shape: str) -> tuple[Array, Array]:
    rng = np.random.default_rng(5)
    t = np.linspace(10.0, 40.0, 60_000)
    x = (t - 25.0) / 15.0
    slow = {"flat": 0.0 * x, "linear": 1.0 * x, "nonlinear": np.sin(3.0 * x)}[shape]
    return slow + 0.05 * rng.standard_normal(len(t)), t


@pytest.mark.parametrize("shape", ["flat", "linear", "nonlinear"])
def test_verdict_on_the_temperature(shape: str) -> None:
    value, t = warm(shape)
    found = thermal(value, t, RATE_HZ, flat=0.1)
    assert found is not None
    assert found.verdict == shape
    assert found.compensable == (shape == "linear")
    if shape == "linear":
        assert found.low < 1.0 / 15.0 < found.high
        assert found.after < 0.1 * found.before


def test_no_verdict_without_a_change_of_temperature_and_no_curve_from_two_points() -> None:
    value, t = warm("linear")
    assert thermal(value[:5000], t[:5000], RATE_HZ, 0.1) is None
    ends = (t < 13.0) | (t > 37.0)
    found = thermal(value[ends], t[ends], RATE_HZ, 0.1)
    assert found is not None
    assert found.verdict == "two points only"


# -- recordings -------------------------------------------------------------------------------------------


def test_raw_counts_need_a_scale(tmp_path: Path) -> None:
    columns = {f"{kind}_{a}_raw": np.zeros(10) for kind in ("acc", "gyro") for a in "xyz"}
    np.savez(tmp_path / "log.npz", **columns)
    with pytest.raises(InputError, match="--accel-lsb-per-g"):
        load_series(tmp_path / "log.npz", rate_hz=100.0)
    assert load_series(tmp_path / "log.npz", Scales(16384.0, 131.0), 100.0).seconds == pytest.approx(0.1)


def test_mpu6050_recordings(shared_data: Path) -> None:
    folder, scales = shared_data / "mpu6050_tomisuarez", Scales(16384.0, 131.0)
    turned = evaluate_turned(load_series(folder / "calibration.npz", scales))
    published = -np.array([-711.516, 358.505, 1840.128]) / 16384.0  # the set adds its bias
    by_poses = [turned["poses_g"][a] for a in "xyz"]
    assert by_poses == pytest.approx(published, abs=0.002)
    # hand-held extremes of ten poses are a coarser method
    assert [turned["manual_g"][a] for a in "xyz"] == pytest.approx(published, abs=0.005)
    result = evaluate_still(load_series(folder / "static_449s.npz", scales))
    drift = result["drift_deg_per_min"]
    assert max(abs(v) for v in drift["before"].values()) > 100.0
    assert max(abs(v) for v in drift["after"].values()) < 1.0  # Table 5.7: below 1 degree per minute


def test_bmi270_temperature_coefficients_are_the_published_ones(shared_data: Path) -> None:
    folder = shared_data / "bmi270_thermal"
    parts = [load_series(folder / f"{name}.npz", Scales(accel_factor=4.0)) for name in ("cold", "hot")]
    axes = evaluate_parts(parts)["thermal"]["axes"]
    slopes = [axes[f"gyro_{a}"]["slope_per_K"] for a in "xyz"]
    assert slopes == pytest.approx([0.019127, 0.01286, -0.001489], abs=2e-5)
    assert set(axes) == {"gyro_x", "gyro_y", "gyro_z"}  # another pose: nothing on the accelerometer
    wrong = evaluate_still(load_series(folder / "cold.npz"))
    assert "a factor 3.9" in wrong["warnings"][0]


@pytest.mark.parametrize(("name", "fall_s"), [("2mps_sphere_1_acc", 0.204), ("4mps_sphere_1_acc", 0.398)])
def test_drops_of_an_impactor(shared_data: Path, name: str, fall_s: float) -> None:
    found = evaluate_fall(load_series(shared_data / "impack_drop" / f"{name}.npz"))
    assert found["fall_s"] == pytest.approx(fall_s, abs=0.010)
    assert list(found["offset_g"].values()) == pytest.approx([0.005, 0.009, 0.013], abs=0.0015)


def test_a_time_column_goes_before_the_rate_asked_for(tmp_path: Path) -> None:
    columns = {f"acc_{a}_g": np.full(50, float(a == "z")) for a in "xyz"}
    np.savez(tmp_path / "timed.npz", t_s=np.arange(50) / 200.0, **columns)
    np.savez(tmp_path / "plain.npz", **columns)
    assert load_series(tmp_path / "timed.npz", rate_hz=50.0).rate_hz == pytest.approx(200.0)
    assert load_series(tmp_path / "plain.npz", rate_hz=50.0).rate_hz == 50.0


def test_joining_needs_one_rate() -> None:
    other = Series("other", 50.0, np.zeros((10, 3)), None)
    with pytest.raises(InputError, match="50 Hz"):
        join_series([still(), other])


# -- emulated chips ---------------------------------------------------------------------------------------

CHIPS = {
    "mpu6050": "address = 0x69",
    "lsm6ds3": "address = 0x6A",
    "bmx055": "address = 0x18\ngyro_address = 0x68\nmag_address = 0x10",
}
BENCH = """
format = 1
name = "rest"
[emulation]
provider = "sim_devices.register:provider"
seed = 5
[emulation.endoscope]
scenario = "rest"
[bus.i2c0]
kind = "i2c"
uri = "sim://i2c0"
speed_hz = 400_000
[device.chip]
driver = "{driver}"
bus = "i2c0"
rate_hz = 104
gyro_range_dps = 2000.0
{address}
"""


@pytest.mark.parametrize("mode", ["data ready", "fifo"])
@pytest.mark.parametrize("driver", list(CHIPS))
def test_auto_calibration_in_the_registers_of_each_chip(driver: str, mode: str, tmp_path: Path) -> None:
    path = tmp_path / "bench.toml"
    path.write_text(BENCH.format(driver=driver, address=f'{CHIPS[driver]}\nmode = "{mode}"'))
    with open_bench(load_bench(path), pace="virtual", runtime_dir=tmp_path) as opened:
        sensors = open_sensors(opened, may_drain=True)
        sensors.start()
        chip = sensors.by_name["chip"]
        result = auto_calibrate(chip, opened.clock, settle_s=0.5, mean_s=3.0)
        assert result.verified
        assert max(abs(v) for v in result.found_dps) > 0.1
        # what is left is what the register's own steps leave, and the mean's noise
        assert max(abs(v) for v in result.left_dps) < 0.05
        assert max(abs(v) for v in result.left_g) < (0.005 if driver == "bmx055" else 0.001)
        after = record(chip, opened.clock, 2.0)
        assert after.seconds == pytest.approx(2.0, abs=0.02)
        assert after.lost == 0
        assert simple(after) == pytest.approx(result.left_g, abs=0.001)


def test_a_loop_that_reads_sample_by_sample_refuses_a_fifo(tmp_path: Path) -> None:
    path = tmp_path / "bench.toml"
    path.write_text(BENCH.format(driver="lsm6ds3", address=CHIPS["lsm6ds3"] + '\nmode = "fifo"'))
    with (
        open_bench(load_bench(path), pace="virtual", runtime_dir=tmp_path) as opened,
        pytest.raises(BenchError, match="'fifo' is for micron imu"),
    ):
        open_sensors(opened)


# -- the command ------------------------------------------------------------------------------------------


def test_command(tmp_path: Path) -> None:
    series = still(30.0)
    columns = {f"acc_{a}_g": series.accel_g[:, i] for i, a in enumerate("xyz")}
    assert series.gyro_dps is not None
    columns |= {f"gyro_{a}_deg_s": series.gyro_dps[:, i] for i, a in enumerate("xyz")}
    np.savez(tmp_path / "rest.npz", **columns)
    runner = CliRunner()
    out, png = tmp_path / "out.json", tmp_path / "out.png"
    arguments = ["imu", str(tmp_path / "rest.npz"), "--rate-hz", "100"]
    done = runner.invoke(app, [*arguments, "--json", str(out), "--picture", str(png)])
    assert done.exit_code == 0, done.output
    assert png.stat().st_size > 10_000
    found = json.loads(out.read_text())["sensors"][0]
    assert found["offset"]["gyroscope_dps"]["x"] == pytest.approx(1.5, abs=0.01)
    assert runner.invoke(app, ["imu"]).exit_code == 2
    assert runner.invoke(app, ["imu", "--fall", str(tmp_path / "rest.npz"), "--rate-hz", "100"]).exit_code == 2


@pytest.mark.parametrize("command", [["imu", "--seconds", "5"], ["run", "--seconds", "1"]])
def test_clashing_addresses_are_refused_with_the_strap_that_frees_one(command: list[str], tmp_path: Path) -> None:
    path = tmp_path / "bench.toml"
    other = '[device.other]\ndriver = "mpu6050"\nbus = "i2c0"\naddress = 0x68\n'
    path.write_text(BENCH.format(driver="bmx055", address=CHIPS["bmx055"]) + other)
    done = micron(*command, "--bench", path, "--virtual")
    assert done.exit_code == 2
    assert "0x68 on 'i2c0' is claimed by the gyro of 'chip' (BMX055) and 'other' (MPU6050)" in done.stderr
    assert "tie AD0 of 'other' high" in done.stderr
