"""The whole instrument: time, demands, truth, determinism; its kernel against pure Python."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sim_devices.config import AmplifierConfig, EmulationConfig, ManipulatorConfig, SensorConfig, StackConfig
from sim_devices.plant import kernel
from sim_devices.plant.hand import SyntheticHand
from sim_devices.plant.instrument import BLOCK_MS, Instrument

from .stand import PERFECT, Still, perfect

MS = 1_000_000
LINEAR = EmulationConfig(
    sensors=SensorConfig(**PERFECT),
    stack=StackConfig(slip_sum=0.0, curvature=0.0, creep_per_decade=0.0, stroke_spread=0.0, expansion_um_per_K=0.0),
    manipulator=ManipulatorConfig(
        lever_spread=0.0, mount_spread_deg=0.0, tilt_spread_deg=0.0, length_spread=0.0, rest_spread_um=0.0
    ),
    amplifier=AmplifierConfig(bandwidth_hz=1e5, output_ohm=1e-3, slew_V_per_ms=1e6),
)


def instrument(seed=1, config=None, **options):
    config = config or EmulationConfig()
    return Instrument(config, seed, SyntheticHand(config.hand, seed), **options)


def drive(unit, milliseconds, step_ns=MS):
    out = []
    for t in range(step_ns, milliseconds * MS + 1, step_ns):
        unit.advance_to(t)
        if t % MS == 0:
            out.append(unit.analog_V.copy())
            for channel in range(3):
                unit.set_demand_V(channel, 50.0 + 3.0 * math.sin(1e-8 * t + channel), t)
    return np.array(out), unit.truth()


def test_same_seed_same_run_however_time_is_cut():
    a, at = drive(instrument(), 200)
    b, bt = drive(instrument(), 200, step_ns=MS // 8)
    c, _ = drive(instrument(), 200, step_ns=MS // 10)
    assert np.array_equal(a, b)
    assert np.array_equal(a, c)
    for name in at:
        assert np.array_equal(at[name], bt[name])
    d, _ = drive(instrument(seed=2), 200)
    assert not np.array_equal(a, d)


def test_truth_has_a_row_each_millisecond_from_zero_on():
    rows = 4096 + 3 * BLOCK_MS
    unit = instrument()
    unit.advance_to(rows * MS + 7)
    truth = unit.truth()
    assert truth["t_ns"].dtype == np.int64
    assert truth["t_ns"].tolist() == [k * MS for k in range(rows + 1)]
    for name, _, width in kernel.TRUTH:
        assert truth[name].shape == ((rows + 1,) if width == 1 else (rows + 1, width))
        assert np.all(np.isfinite(truth[name]))
    hand = SyntheticHand(EmulationConfig().hand, 1)
    pose, parts = np.zeros((rows, 18)), np.zeros((rows, 6))
    hand.fill(pose, parts)
    assert np.array_equal(truth["tip_rigid_m"][1:], pose[:, :3])
    assert np.array_equal(truth["tremor_m"][1:], parts[:, 3:])
    assert np.array_equal(truth["intended_m"][1:], parts[:, :3])
    attitudes = hand.frame @ Rotation.from_euler("ZYX", pose[:, [5, 4, 3]]).as_matrix()
    ours = Rotation.from_quat(truth["quaternion"][1:], scalar_first=True).as_matrix()
    assert np.abs(ours - attitudes).max() < 1e-12
    last = unit.truth_row()
    assert np.array_equal(last["tip_m"], truth["tip_m"][-1])
    assert np.array_equal(last["tremor_m"], truth["tremor_m"][-1])


def test_at_neutral_the_tip_is_where_the_rigid_tip_is():
    unit = instrument()
    unit.advance_to(50 * MS)
    truth = unit.truth()
    # thermal expansion is common to the three stacks: less than a nanometre in that time
    assert np.abs(truth["tip_m"] - truth["tip_rigid_m"]).max() < 1e-9


def test_demands_move_the_tip_along_the_body_axes():
    """All three up 10 V: 1.5 um of stack, 12 um along the shaft, which here points up in the world."""
    unit = Instrument(LINEAR, 1, Still(), quiet=True)
    for channel in range(3):
        unit.set_demand_V(channel, 60.0, 0)
    unit.advance_to(500 * MS)
    moved = unit.truth()["tip_m"][-1]
    assert moved == pytest.approx([0.0, 0.0, 12e-6], abs=2e-10)
    unit = Instrument(LINEAR, 1, Still(), quiet=True)
    unit.set_demand_V(0, 60.0, 0)  # ball 1 up by 12 um: a_x = -2/3 12e-6 / 5e-3
    unit.advance_to(500 * MS)
    assert unit.truth()["tip_m"][-1] == pytest.approx([-0.04 * 1.6e-3, 0.0, 4e-6], abs=6e-8)


def test_a_demand_counts_from_its_own_nanosecond_on():
    """The fast amplifier follows the mean of the demand over the running step: linear in the instant."""
    reached = []
    for t_ns in (2 * MS, 2 * MS + 31_250, 2 * MS + 62_500, 2 * MS + 125_000):
        unit = Instrument(LINEAR, 1, Still(), quiet=True)
        unit.set_demand_V(1, 58.0, t_ns)
        unit.advance_to(2 * MS + 125_000)
        reached.append(unit.truth_row()["amplifier_V"][1])
    assert reached == pytest.approx([58.0, 56.0, 54.0, 50.0], abs=1e-9)


def test_several_demands_within_one_step_add_up():
    unit = Instrument(LINEAR, 1, Still(), quiet=True)
    unit.set_demand_V(0, 90.0, 2 * MS)
    unit.set_demand_V(0, 50.0, 2 * MS + 25_000)  # 40 V for a fifth of the step
    unit.advance_to(2 * MS + 125_000)
    assert unit.truth_row()["amplifier_V"][0] == pytest.approx(58.0, abs=1e-9)
    unit.advance_to(2 * MS + 250_000)
    assert unit.truth_row()["amplifier_V"][0] == pytest.approx(50.0, abs=1e-6)


def test_a_late_demand_counts_from_now():
    unit = Instrument(LINEAR, 1, Still(), quiet=True)
    unit.advance_to(5 * MS)
    unit.set_demand_V(2, 60.0, 3 * MS)
    assert unit.now_ns == 5 * MS
    unit.advance_to(5 * MS + 125_000)
    assert unit.truth_row()["amplifier_V"][2] == pytest.approx(60.0, abs=1e-9)


def test_time_never_goes_back():
    unit = instrument()
    unit.advance_to(3 * MS)
    unit.advance_to(1 * MS)
    assert unit.now_ns == 3 * MS
    assert len(unit.truth()["t_ns"]) == 4


def test_between_steps_outputs_follow_the_rc():
    unit = instrument(config=perfect(noise_ug_per_rtHz=0.0))
    unit.advance_to(100 * MS)
    here = unit.analog_V.copy()
    unit.advance_to(100 * MS + 124_999)
    nearly = unit.analog_V.copy()
    unit.advance_to(100 * MS + 125_000)
    after = unit.analog_V.copy()
    assert np.abs(after - here)[:6].max() > 0.0
    assert np.all(np.abs(nearly - after)[:6] < 0.02 * np.abs(after - here)[:6].max() + 1e-7)


def test_accelerometers_read_the_motion_of_the_tip_they_are_rigidly_fixed_to():
    """Perfect sensors without RC: six readings give back the specific force from differentiated truth."""
    config = perfect(noise_ug_per_rtHz=0.0, rc_ohm=1.0)
    unit = instrument(config=config)
    v = np.empty((1000, 6))
    for k in range(1000):
        unit.advance_to((k + 1) * MS)
        v[k] = unit.analog_V[:6]
    truth = unit.truth()
    c = Rotation.from_quat(truth["quaternion"], scalar_first=True).as_matrix()
    arms = unit.unit.sensors.positions_m - np.array(config.instrument.tip_mm) * 1e-3
    for i, (location, axis) in enumerate(((0, 0), (0, 2), (1, 1), (1, 2), (2, 0), (2, 1))):
        p = truth["tip_rigid_m"] + c @ arms[location]
        a = (-p[:-4] + 16 * p[1:-3] - 30 * p[2:-2] + 16 * p[3:-1] - p[4:]) / (12 * 1e-6)
        f = np.einsum("nji,nj->ni", c[2:-2], a + np.array([0.0, 0.0, 9.80131]))[:, axis]
        assert np.abs((v[1:-2, i] - 2.5) * 9.80665 - f).max() < 2e-4 * np.std(f) + 1e-4


def test_quiet_is_without_any_noise():
    v, _ = drive(instrument(config=perfect(), quiet=True), 40)
    w, _ = drive(Instrument(perfect(), 1, Still(), quiet=True), 40)
    assert w.std(axis=0)[:7] == pytest.approx(0.0, abs=1e-14)
    assert v.std(axis=0)[:6].min() > 0.0


def test_compiled_and_python_agree():
    """The whole kernel, one block, both ways."""
    results = []
    for advance, begin, outputs in (
        (kernel.advance, kernel.begin, kernel.outputs),
        (kernel.advance.py_func, kernel.begin.py_func, kernel.outputs.py_func),
    ):
        unit = instrument(config=EmulationConfig())
        unit._next_block()
        unit._state[0]["demand_V"] = (55.0, 42.0, 50.5)
        truth = np.zeros((BLOCK_MS + 1, kernel.TRUTH_COLUMNS))
        begin(unit._plant, unit._state, unit._nodes[0], unit._part, truth[0])
        row = advance(unit._plant, unit._state, unit._block, (0, 24), truth, 1)
        assert row == 4
        stepped = unit._daq_V.copy(), unit._magnetometer_V.copy()
        outputs(unit._plant[0], unit._state[0], 5e-5)
        results.append((truth, *stepped, unit._daq_V.copy(), unit._magnetometer_V.copy()))
    for ours, python in zip(*results, strict=True):
        assert np.allclose(ours, python, rtol=1e-10, atol=1e-15)


@pytest.mark.parametrize("name", ["room", "sense", "truth_row"])
def test_parts_of_the_kernel_in_python(name):
    units = [instrument(), instrument()]
    arguments = {
        "room": lambda: (np.array([0.4, -1.2]),),
        "sense": lambda: (np.linspace(-1.0, 1.0, kernel.NOISES),),
        "truth_row": lambda: (np.arange(6.0), np.zeros(kernel.TRUTH_COLUMNS)),
    }[name]
    called = [arguments(), arguments()]
    getattr(kernel, name)(units[0]._plant[0], units[0]._state[0], *called[0])
    getattr(kernel, name).py_func(units[1]._plant[0], units[1]._state[0], *called[1])
    for field in ("rc_V", "sensor_V", "attitude", "temperature_C", "supply_V"):
        assert np.allclose(units[0]._state[0][field], units[1]._state[0][field], rtol=1e-12)
    assert np.allclose(called[0][-1], called[1][-1], rtol=1e-12)
