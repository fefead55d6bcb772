"""The whole emulated bench as a twin: against the same plant stepped by hand, and through the engine."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hal.bench import load_bench
from sim_devices.config import emulation_config
from sim_devices.physics.catalogue import EFFECTS
from sim_devices.plant.hand import holding_frame
from sim_devices.plant.instrument import Instrument
from sim_devices.plant.recorded_hand import make_hand
from tests.conftest import DEFAULT_BENCH
from tools.errors import RecordingError
from tools.mismatch.infer import diagnose
from tools.mismatch.recording_load import load
from tools.mismatch.twins.instrument import GivenHand, simulate_instrument
from tools.mismatch.twins.make import make

RATE_HZ = 1000.0


def commands(n: int) -> np.ndarray:
    t = np.arange(n) / RATE_HZ
    return 50.0 + np.column_stack([20 * np.sin(2 * np.pi * f * t) for f in (3.0, 5.0, 7.0)])


def recorded(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Tip (n, 3) m and DAQ volts (n, 8) of the noisy plant at rest in a vice, driven by ``commands``."""
    config = emulation_config(load_bench(DEFAULT_BENCH).description.model_dump())
    t = np.arange(n) / RATE_HZ
    hand = GivenHand(holding_frame(config.hand), t, np.zeros((n, 6)))
    plant = Instrument(config, 11, hand, unit=config.unit)
    tip, volts, wanted = np.empty((n, 3)), np.empty((n, 8)), commands(n)
    for k in range(n):
        t_ns = k * 1_000_000
        plant.advance_to(t_ns)
        tip[k], volts[k] = plant.truth_row()["tip_m"], plant.analog_V
        for channel in range(3):
            plant.set_demand_V(channel, wanted[k, channel], t_ns)
    return tip, volts


def write(folder: Path, n: int, extra_um: np.ndarray | float = 0.0) -> Path:
    tip, _ = recorded(n)
    noise_um = 0.07 * np.random.default_rng(3).standard_normal(n)
    columns = {f"c{i + 1}": commands(n)[:, i] for i in range(3)}
    np.savez(folder / "data.npz", tip=1e6 * tip[:, 0] + noise_um + extra_um, **columns)
    channels = "".join(
        f'[[channels]]\ncolumn = "c{i}"\nrole = "input"\nsignal = "command_{i}"\nunit = "V"\n' for i in (1, 2, 3)
    )
    (folder / "recording.toml").write_text(
        f'format = 1\ntitle = "bench in a vice"\ndata = "data.npz"\nrate_hz = {RATE_HZ}\n'
        f'[twin]\nkind = "instrument"\n[twin.parameters]\nbench = "{DEFAULT_BENCH}"\n{channels}'
        '[[channels]]\ncolumn = "tip"\nrole = "output"\nsignal = "tip_x"\nunit = "um"\nnoise_rms = 0.07\n'
    )
    return folder / "recording.toml"


def test_the_twin_is_the_plant_without_its_noise():
    n = 400
    config = emulation_config(load_bench(DEFAULT_BENCH).description.model_dump())
    inputs = {f"command_{i + 1}": commands(n)[:, i] for i in range(3)} | {"t": np.arange(n) / RATE_HZ}
    simulated = simulate_instrument(config, inputs)
    tip, volts = recorded(n)
    # the stacks have no noise but the room's temperature, which wanders (8 pm at the tip in 0.4 s when measured)
    np.testing.assert_allclose(simulated["tip_x"], tip[:, 0], rtol=0.0, atol=1e-9)
    assert np.std(simulated["volts_0"] - volts[:, 0]) < 2e-3


def test_the_benchs_own_hand_moves_the_twin_from_the_given_moment_on():
    n, skipped = 120, 30
    config = emulation_config(load_bench(DEFAULT_BENCH).description.model_dump())
    hand = make_hand(config.hand, config.seed, None, None)
    plant = Instrument(config, config.seed, hand, unit=config.unit, quiet=True)
    volts = np.empty(n + skipped)
    for k in range(n + skipped):
        plant.advance_to(k * 1_000_000)
        volts[k] = plant.analog_V[0]
    inputs = {"t": np.arange(n) / RATE_HZ}
    twin = simulate_instrument(config, inputs, ("volts_0",), own_hand=True, start_s=skipped / RATE_HZ)
    np.testing.assert_allclose(twin["volts_0"], volts[skipped:], rtol=0.0, atol=1e-12)
    assert np.ptp(volts) > 1e-4


def test_wrong_signals_and_benches_are_named(tmp_path: Path):
    path = write(tmp_path, 300)
    good = path.read_text()
    for old, new, words in (
        ("command_2", "drive_2", "no input 'drive_2'"),
        ('"tip_x"', '"nose_x"', "no output 'nose_x'"),
        (str(DEFAULT_BENCH), "nowhere.toml", "nowhere.toml"),
        ("[twin.parameters]", "[twin.parameters]\nhand = 'left'", "'rest' or 'bench'"),
        ("[twin.parameters]", "[twin.parameters]\nstart_s = -1.0", "0 to 3600 s"),
        ("[twin.parameters]", "[twin.parameters]\ngain = 1.0", "'gain' is not a parameter of instrument"),
    ):
        path.write_text(good.replace(old, new))
        with pytest.raises(RecordingError, match=words):
            make(load(path))


def test_the_engine_agrees_with_a_bench_that_is_as_described(tmp_path: Path):
    # one effect of each kind: every candidate at an input runs the whole bench
    some = [EFFECTS[n] for n in ("creep", "dead_time", "saturation", "thermal_drift", "vibration")]
    report = diagnose(load(write(tmp_path, 1000)), seed=0, jobs=1, effects=some)
    assert report.verdict == "agrees"
