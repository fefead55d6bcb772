"""A recording on the instrument: band-limited integration against closed forms, real files, every fault named."""

import math
from pathlib import Path

import numpy as np
import pytest

from sim_devices.config import HandConfig
from sim_devices.plant.hand import SyntheticHand
from sim_devices.plant.hand_file import HandFileError, load_hand
from sim_devices.plant.recorded_hand import RecordedHand, add_recorded, make_hand

DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
STILL = HandConfig(voluntary_range_um=0.0, voluntary_angle_deg=0.0, drift_rms_um=0.0)
G = 9.80665


def needs(path):
    if not path.exists():
        pytest.skip(f"{path} is not on this machine")
    return path


def motion(hand, milliseconds):
    pose, parts = np.zeros((milliseconds + 1, 18)), np.zeros((milliseconds + 1, 6))
    hand.start(pose[0], parts[0])
    hand.fill(pose[1:], parts[1:])
    return pose, parts


def sine_csv(folder, column, amplitude, *, seconds=20.0, rate_hz=200.0, frequency_hz=9.0):
    t = np.arange(round(seconds * rate_hz)) / rate_hz
    y = amplitude * np.sin(2.0 * math.pi * frequency_hz * t)
    path = folder / "hand.csv"
    path.write_text("\n".join([f"t_s,{column}", *(f"{a:.9f},{b:.12g}" for a, b in zip(t, y, strict=True))]))
    return path


@pytest.mark.parametrize(
    ("column", "per_metre"),
    [
        ("acc_x_m_s2", -((2.0 * math.pi * 9.0) ** 2)),
        ("acc_x_g", -((2.0 * math.pi * 9.0) ** 2) / G),
        ("x_um", 1e6),
    ],
)
def test_a_sine_comes_out_as_that_sine_with_its_derivatives(tmp_path, column, per_metre):
    """25 um at 9 Hz, whichever quantity was recorded; in the middle, where nothing is faded."""
    hand = RecordedHand(STILL, 1, load_hand(sine_csv(tmp_path, column, 25e-6 * per_metre)), scale=1.0)
    pose, parts = motion(hand, 12_000)
    middle = slice(5000, 12_000)
    body = [pose[middle, 6 * k : 6 * k + 3] @ hand.frame for k in range(3)]
    t = np.arange(12_001)[middle] * 1e-3
    w = 2.0 * math.pi * 9.0
    for order, value in enumerate(body):
        expected = 25e-6 * w**order * np.sin(w * t + 0.5 * math.pi * order)
        assert np.abs(value[:, 0] - expected).max() < 2e-3 * 25e-6 * w**order
        assert np.abs(value[:, 1:]).max() < 1e-12 * w**order
    assert np.array_equal(parts[:, 3:], pose[:, :3])


def test_an_angular_rate_turns_about_the_grip(tmp_path):
    """1 mrad at 9 Hz about y: the tip, 90 mm from the grip, moves by 90 um along x."""
    path = sine_csv(tmp_path, "gyro_y_rad_s", 1e-3 * 2.0 * math.pi * 9.0)
    hand = RecordedHand(STILL, 1, load_hand(path), scale=1.0)
    pose, _ = motion(hand, 12_000)
    body = pose[5000:, :3] @ hand.frame
    assert np.abs(body[:, 0]).max() == pytest.approx(90e-6, rel=3e-3)
    assert np.abs(pose[5000:, 4]).max() == pytest.approx(1e-3, rel=3e-3)
    assert np.allclose(body[:, 0], 0.09 * pose[5000:, 4], atol=1e-12)


def test_scaled_to_fifty_micrometres_in_the_band(tmp_path):
    path = sine_csv(tmp_path, "x_mm", 3.0)
    hand = make_hand(STILL, 1, path)
    pose, _ = motion(hand, 12_000)
    body = pose[5000:, :3] @ hand.frame
    assert np.ptp(body[:, 0]) == pytest.approx(50e-6, rel=0.04)  # the faded ends take part in the rms
    twice = make_hand(STILL, 1, path, scale=2.0)
    assert twice.scale == 2.0  # type: ignore[union-attr]


def test_a_run_longer_than_the_recording_starts_it_again(tmp_path):
    hand = RecordedHand(STILL, 1, load_hand(sine_csv(tmp_path, "x_um", 25.0, seconds=4.0)), scale=1.0)
    pose, _ = motion(hand, 9_000)
    assert np.allclose(pose[100:4000, :3], pose[4100:8000, :3], atol=1e-15)
    assert np.abs(np.diff(pose[:, 0])).max() < 3e-6  # no jump where it starts again


def test_voluntary_motion_is_the_synthetic_one(tmp_path):
    path = sine_csv(tmp_path, "x_um", 25.0)
    _, parts = motion(RecordedHand(HandConfig(), 4, load_hand(path)), 3000)
    _, own = motion(SyntheticHand(HandConfig(), 4), 3000)
    assert np.array_equal(parts[:, :3], own[:, :3])


def test_uneven_and_repeated_stamps_and_gaps_are_mended_and_said(tmp_path):
    rng = np.random.default_rng(1)
    t = np.cumsum(rng.uniform(0.014, 0.017, 1500))
    t[700:] += 3.0
    t[820] = t[819]
    y = 25.0 * np.sin(2.0 * math.pi * 9.0 * t)
    np.savez(tmp_path / "hand.npz", t_s=t, x_um=y)
    recording = load_hand(tmp_path / "hand.npz")
    assert recording.rate_hz == pytest.approx(64.5, abs=1.0)
    assert len(recording.notes) == 2
    assert recording.displacement is not None
    even = np.arange(len(recording.displacement)) / recording.rate_hz + t[700]
    error = recording.displacement[20:-20, 0] - 25e-6 * np.sin(2.0 * math.pi * 9.0 * even[20:-20])
    assert error.std() < 0.05 * 25e-6


def test_late_stamps_do_not_move_even_samples(tmp_path):
    """Interpolated at such stamps, a tone of 9 Hz is off by a fifth of its size."""
    rng = np.random.default_rng(2)
    even = np.arange(1500) / 64.0
    y = 25.0 * np.sin(2.0 * math.pi * 9.0 * even)
    np.savez(tmp_path / "hand.npz", t_s=np.sort(even + rng.uniform(0.0, 0.012, 1500)), x_um=y)
    recording = load_hand(tmp_path / "hand.npz")
    assert "taken as an even clock" in recording.notes[0]
    assert recording.displacement is not None
    assert np.std(recording.displacement[50:-50, 0] - 1e-6 * y[50:-50]) < 0.05 * 25e-6


def test_a_recording_of_the_contract(tmp_path):
    t = np.arange(2000) / 250.0
    np.savez(tmp_path / "d.npz", a=np.sin(2.0 * math.pi * 9.0 * t), b=np.zeros(2000), c=t)
    (tmp_path / "recording.toml").write_text(
        'format = 1\ndata = "d.npz"\nrate_hz = 250.0\n'
        '[[channels]]\ncolumn = "a"\nrole = "output"\nsignal = "x"\nunit = "um"\n'
        '[[channels]]\ncolumn = "c"\nrole = "context"\nsignal = "temperature"\nunit = "degC"\n'
    )
    for source in (tmp_path, tmp_path / "recording.toml"):
        recording = load_hand(source)
        assert recording.rate_hz == 250.0
        assert recording.displacement is not None
        assert recording.displacement[7, 0] == pytest.approx(1e-6 * math.sin(2.0 * math.pi * 9.0 * t[7]))


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("missing.csv", "does not exist"),
        ("missing.npz", "does not exist"),
        ("hand.txt", "an .npz, a .csv or a recording folder"),
        ("broken.npz", "not a readable .npz"),
        ("words.csv", "line 3"),
        ("short.csv#0:9", "ends at 5.00 s"),
        ("short.csv#3:2", "stops after it starts"),
        ("short.csv#a:b", "#start:stop in seconds"),
        ("short.csv#wrist", "names none in it"),
        ("short.csv#0:2", "needs 4 s or more"),
        ("unknown.csv", "no column is an acceleration"),
        ("backwards.csv", "backwards"),
        ("holes.csv", "not a number at sample 2"),
        ("ragged.csv", "line 3: 1 values"),
        ("slow.csv", "30 Hz or more"),
        ("nothing.csv", "cannot be scaled"),
        ("bad.toml", "bad.toml"),
        ("nodata.toml", "key 'data'"),
        ("texts.toml", "no channel is an acceleration"),
        ("number.toml", "no channel is an acceleration"),
        ("fast.toml", "rate_hz must be a positive number, got 'fast'"),
    ],
)
def test_every_fault_is_named(tmp_path, source, message):
    def table(rows):
        return "\n".join(["t_s,x_um", *rows])

    t = np.arange(500) / 100.0
    (tmp_path / "hand.txt").write_text("x")
    (tmp_path / "texts.toml").write_text('data = "short.csv"\nchannels = ["a"]\n')
    (tmp_path / "number.toml").write_text('data = "short.csv"\nchannels = 3\n')
    channel = '[[channels]]\ncolumn = "x_um"\nunit = "um"\n'
    (tmp_path / "fast.toml").write_text(f'data = "short.csv"\nrate_hz = "fast"\n{channel}')
    (tmp_path / "broken.npz").write_bytes(b"PK not a zip")
    (tmp_path / "words.csv").write_text(table(["0,1", "0.01,one"]))
    (tmp_path / "short.csv").write_text(table(f"{a},{math.sin(60.0 * a)}" for a in t))
    (tmp_path / "unknown.csv").write_text("t_s,width_px\n0,1\n0.01,2\n")
    (tmp_path / "backwards.csv").write_text(table(["0,1", "0.02,1", "0.01,1"]))
    (tmp_path / "holes.csv").write_text(table(["0,1", "0.01,2", "0.02,nan"]))
    (tmp_path / "ragged.csv").write_text(table(["0,1", "0.02"]))
    (tmp_path / "slow.csv").write_text(table(f"{a * 10},1" for a in t))
    (tmp_path / "nothing.csv").write_text(table(f"{a},1" for a in t))
    (tmp_path / "bad.toml").write_text("= 3")
    (tmp_path / "nodata.toml").write_text("format = 1")
    with pytest.raises(HandFileError, match=message):
        make_hand(HandConfig(), 1, str(tmp_path / source))


def test_real_recordings_become_hands():
    """Accelerometer, gyroscope, both: a believable tremor in 8 to 12 Hz and finite derivatives."""
    for source, rate_hz in (
        ("tremor_duke_adxl345/data.npz#10.4low", 101.87),
        ("tremor_paradigma_pd/data.npz#100:160", 100.0),
        ("tremor_mouse_lsm9ds1/imu_23.npz#20:80", 64.2),
    ):
        needs(DATA / source.split("#")[0])
        hand = make_hand(HandConfig(), 1, DATA / source)
        assert isinstance(hand, RecordedHand)
        assert hand.recording.rate_hz == pytest.approx(rate_hz, abs=0.1)
        assert hand.tremor_rms_m == pytest.approx(50e-6 / (2.0 * math.sqrt(2.0)))
        pose, parts = motion(hand, 4000)
        assert np.all(np.isfinite(pose))
        assert parts[:, 3:].std() > 1e-6


def test_a_file_with_many_recordings_asks_which():
    path = needs(DATA / "tremor_duke_adxl345" / "data.npz")
    with pytest.raises(HandFileError, match=r"holds 49 recordings: choose one with data\.npz#NAME; names: .*10\.4low"):
        load_hand(path)
    with pytest.raises(HandFileError, match="no recording 'nobody'"):
        load_hand(f"{path}#nobody")
    assert load_hand(f"{path}#0").seconds == pytest.approx(load_hand(f"{path}#10.4low").seconds)


def test_compiled_and_python_agree(tmp_path):
    hand = RecordedHand(STILL, 1, load_hand(sine_csv(tmp_path, "x_um", 25.0, seconds=5.0)), scale=1.0)
    a, ap, b, bp = np.zeros((9, 18)), np.zeros((9, 6)), np.zeros((9, 18)), np.zeros((9, 6))
    add_recorded(hand._table, hand._span_s, 1234, a, ap)
    add_recorded.py_func(hand._table, hand._span_s, 1234, b, bp)
    assert np.allclose(a, b, rtol=1e-12, atol=1e-18)
    assert np.allclose(ap, bp, rtol=1e-12, atol=1e-18)
