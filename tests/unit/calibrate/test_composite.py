"""The physical model of Ang 2004 sec. 3.2.1 against voltages made from it, and on an instrument that does not obey
it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from firmware_py.records import attributes
from firmware_py.sensing.calibration import calibration_params, composite
from firmware_py.sensing.config import SensingConfig
from sim_devices.config import EmulationConfig
from sim_devices.plant.lab import measure_tumble
from tools.calibrate.composite import fit_composite
from tools.calibrate.field_frame import fit_field
from tools.calibrate.stage_log import load_stage_log, stage_attitude
from tools.calibrate.tumble import identify, refuse_drift
from tools.errors import InputError

IN_PLANE, OUT_OF_PLANE = (1, 0, 0), (2, 2, 1)
BIAS = np.array([2.46, 2.53, 2.51])
SCALE = np.array([0.98, 1.01, 1.02])
BENT = np.array([[0.010, -0.006, 0.004, 0.003], [-0.004, 0.008, -0.002, 0.001], [0.002, 0.003, 0.005, -0.004]])


def directions(n: int = 60) -> np.ndarray:
    """Unit vectors spread over the sphere, in no order."""
    v = np.random.default_rng(3).normal(size=(n, 3))
    return v / np.linalg.norm(v, axis=1)[:, None]


def sensing_axes() -> np.ndarray:
    axes = np.eye(3) + 0.02 * np.random.default_rng(4).normal(size=(3, 3))
    return axes / np.linalg.norm(axes, axis=1)[:, None]


def bent_volts(force: np.ndarray) -> np.ndarray:
    """Voltages that (3.11) with the numbers above turns into theta . f, by fixed point."""
    along = force @ sensing_axes().T
    reading = along.copy()
    for _ in range(60):
        y, z = reading[:, IN_PLANE], reading[:, OUT_OF_PLANE]
        p, q, r1, r2 = BENT.T
        reading = along * (1.0 + r1 * z + r2 * z * z) + p * y * y + q * z * z
    return BIAS + SCALE * reading


def test_the_parameters_that_made_the_voltages_come_back() -> None:
    force = directions()
    fit = fit_composite(bent_volts(force), force, IN_PLANE, OUT_OF_PLANE)
    for i, axis in enumerate(fit.axes):
        assert axis.value("bias_V") == pytest.approx(BIAS[i], abs=1e-9)
        assert axis.scale_V_per_g == pytest.approx(SCALE[i], abs=1e-9)
        np.testing.assert_allclose(axis.direction, sensing_axes()[i], atol=1e-9)
        names = ("in_plane_2", "out_of_plane_2", "scale_1", "scale_2")
        np.testing.assert_allclose([axis.value(n) for n in names], BENT[i], atol=1e-8)
        assert axis.residual_rms_V < 1e-9 < axis.linear_rms_V
    assert fit.missing == ()


def test_intervals_hold_the_truth_about_as_often_as_they_say() -> None:
    force, rng = directions(), np.random.default_rng(5)
    inside = []
    for _ in range(25):
        noisy = bent_volts(force) + 2e-4 * rng.normal(size=(len(force), 3))
        for i, axis in enumerate(fit_composite(noisy, force, IN_PLANE, OUT_OF_PLANE).axes):
            e = axis.parameters["in_plane_2"]
            inside.append(e.low < BENT[i, 0] < e.high)
    assert 0.85 < np.mean(inside) <= 1.0


def test_the_kernel_takes_off_what_was_identified() -> None:
    """Two packages of the three synthetic axes: the firmware reads theta . f again."""
    force = directions(40)
    fit = fit_composite(bent_volts(force), force, IN_PLANE, OUT_OF_PLANE)
    twice = (0, 1, 2, 0, 1, 2)
    config = SensingConfig(
        in_plane=(1, 0, 0, 4, 3, 3),
        out_of_plane=(2, 2, 1, 5, 5, 4),
        bias_in_plane=tuple((0.0, fit.axes[i].value("in_plane_2")) for i in twice),
        bias_out_of_plane=tuple((0.0, fit.axes[i].value("out_of_plane_2")) for i in twice),
        scale_out_of_plane=tuple((fit.axes[i].value("scale_1"), fit.axes[i].value("scale_2")) for i in twice),
    )
    params, g = calibration_params(config), config.gravity_m_s2
    lines = ((bent_volts(force) - BIAS) / SCALE * g)[:, twice]
    out, twin = np.empty(6), np.empty(6)
    for line, f in zip(lines, force, strict=True):
        composite(line, params[0], out)
        np.testing.assert_allclose(out / g, (sensing_axes() @ f)[list(twice)], atol=1e-9)
        composite.py_func(line, attributes(params)[0], twin)  # type: ignore[attr-defined]
        np.testing.assert_array_equal(twin, out)


def test_a_drift_is_refused_or_fitted() -> None:
    force = directions()
    ramp = np.linspace(-0.5, 0.5, len(force))[:, None] * np.array([0.010, 0.0, 0.0])
    volts = bent_volts(force) + ramp
    with pytest.raises(InputError, match=r"axis 0 moved by 10\.2 mg"):
        refuse_drift(fit_composite(volts, force, IN_PLANE, OUT_OF_PLANE))
    fit = fit_composite(volts, force, IN_PLANE, OUT_OF_PLANE, fit_drift=True)
    assert fit.axes[0].drift.value == pytest.approx(0.010, abs=1e-9)
    assert fit.axes[0].value("bias_V") == pytest.approx(BIAS[0], abs=1e-9)


def test_a_drift_that_looks_like_an_axis_cannot_be_fitted() -> None:
    """A spiral from pole to pole: gravity along z falls as steadily as time goes on."""
    n = 60
    z = np.linspace(-1.0, 1.0, n)
    r, turn = np.sqrt(1.0 - z * z), 2.4 * np.arange(n)
    spiral = np.column_stack([r * np.cos(turn), r * np.sin(turn), z])
    assert np.isinf(fit_composite(bent_volts(spiral), spiral, IN_PLANE, OUT_OF_PLANE).axes[0].drift.high)
    with pytest.raises(InputError, match="another order"):
        fit_composite(bent_volts(spiral), spiral, IN_PLANE, OUT_OF_PLANE, fit_drift=True)


def test_poses_that_show_too_little_are_named() -> None:
    with pytest.raises(InputError, match="5 poses"):
        fit_composite(bent_volts(directions(5)), directions(5), IN_PLANE, OUT_OF_PLANE)
    flat = directions()
    flat[:, 2] = 0.0
    with pytest.raises(InputError, match="z up, z down"):
        fit_composite(bent_volts(flat), flat, IN_PLANE, OUT_OF_PLANE)


def test_on_emulated_sensors_of_another_form_the_model_beats_the_line_on_poses_it_never_saw() -> None:
    columns, _ = measure_tumble(EmulationConfig(unit=3), 100, 5.0)
    result = identify(columns)
    line = [axis.linear_rms_V for axis in result.accelerometers.axes]
    left_out = [axis.held_out_rms_V for axis in result.accelerometers.axes]
    assert np.mean(left_out) < 0.35 * np.mean(line)
    # what is left is the form that the model does not know, far above the noise of a mean (35 uV)
    assert np.mean([axis.residual_rms_V for axis in result.accelerometers.axes]) > 1e-4
    assert result.magnetometer.offset_V is not None


def test_pulses_tell_the_bridge_from_hard_iron() -> None:
    rng = np.random.default_rng(6)
    alpha, beta = rng.uniform(-np.pi, np.pi, (2, 40))
    attitude = stage_attitude(alpha, beta)
    np.testing.assert_allclose(attitude @ attitude.transpose(0, 2, 1), np.tile(np.eye(3), (40, 1, 1)), atol=1e-12)
    matrix = 0.01 * (np.eye(3) + 0.02 * rng.normal(size=(3, 3)))
    field, iron, bridge = np.array([20.0, 0.0, -45.0]), np.array([0.5, -0.3, 0.2]), np.array([2.51, 2.48, 2.50])
    seen = (attitude.transpose(0, 2, 1) @ field + iron) @ matrix.T
    fit = fit_field(attitude, bridge + seen, bridge - seen)
    assert fit.offset_V is not None
    np.testing.assert_allclose([e.value for e in fit.offset_V], bridge, atol=1e-12)
    np.testing.assert_allclose([e.value for e in fit.bias], bridge + matrix @ iron, atol=1e-9)
    gauge = np.cbrt(np.linalg.det(matrix)) / 0.01
    np.testing.assert_allclose(fit.matrix * gauge, matrix, atol=1e-9)


def test_a_log_of_poses_is_averaged_over_their_last_five_seconds(tmp_path: Path) -> None:
    """10 Hz, 6 s a pose; the first second is off and must not count."""
    rows = ["t_s,alpha_deg,beta_deg,acc"]
    for k in range(180):
        pose, inside = divmod(k, 60)
        rows.append(f"{k / 10},{30 * pose},{-45 * pose},{pose + (5.0 if inside < 10 else 0.0)}")
    (tmp_path / "log.csv").write_text("\n".join(rows) + "\n")
    log = load_stage_log(tmp_path / "log.csv")
    np.testing.assert_allclose(log.columns["acc"], [0.0, 1.0, 2.0])
    np.testing.assert_allclose(log.attitude[1], stage_attitude(np.radians([30.0]), np.radians([-45.0]))[0])
    # alpha 90, beta 0: x along gravity, so it reads -1 g (Ang 2004 Fig. 3.3, erratum 2)
    np.testing.assert_allclose(stage_attitude(np.array([np.pi / 2]), np.zeros(1))[0, 2], [-1.0, 0.0, 0.0], atol=1e-12)
    (tmp_path / "other.csv").write_text("t_s,acc\n0,1\n0.1,1\n")
    with pytest.raises(InputError, match="no stage angles"):
        load_stage_log(tmp_path / "other.csv")
