"""The lag of the accelerometers from a shaker, and its remedy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from firmware_py.control.plan import load_plan
from hal.bench import load_bench
from sim_devices.plant.lab_motion import SHAKE_M_S2, SHAKES_HZ, shake_path
from tests.unit.mismatch_heal.test_heal import MICRON, concealed, lab_of
from tools.calibrate.sensor_lag import identify_lag, lag_at
from tools.heal.heal import with_remedy
from tools.heal.parts import compare_lag, identify_timing

DT = 1e-3


def test_filter_and_delay_are_told_apart():
    hz, t = np.array(SHAKES_HZ), np.arange(10_000) * DT
    rng = np.random.default_rng(1)
    said = np.column_stack([np.sum(np.sin(2 * np.pi * np.outer(t, hz[k::3])), axis=1) for k in (0, 1, 2, 0, 1, 2)])
    gain = lag_at(0.012, 0.0015, hz)
    recorded = np.zeros_like(said)
    for k in range(6):
        for h, g in zip(hz[k % 3 :: 3], gain[k % 3 :: 3], strict=True):
            recorded[:, k] += np.imag(g * np.exp(2j * np.pi * h * t))
    found = identify_lag(said, recorded + 0.01 * rng.standard_normal(said.shape), DT, hz)
    assert found.filter_s == pytest.approx(0.012, rel=0.01)
    assert found.delay_s == pytest.approx(0.0015, abs=3e-5)


def test_the_path_of_the_shaker_is_its_own_derivative():
    nodes = shake_path(2.0)
    for order in (0, 1):
        here, there = nodes[:, 6 * order : 6 * order + 3], nodes[:, 6 * order + 6 : 6 * order + 9]
        slope = (here[2:] - here[:-2]) / (2 * DT)
        assert np.max(np.abs(slope - there[1:-1])) < 0.02 * np.max(np.abs(there))
    assert np.max(np.abs(nodes[:, 12])) <= 4 * SHAKE_M_S2


def test_a_slower_filter_is_seen_and_its_remedy_is_exact(tmp_path: Path):
    path = concealed(tmp_path, "[emulation.sensors]\nrc_farad = 0.43e-6\nrc_spread = 0.0")
    lab = lab_of(path, tmp_path)
    # atan(w RC) / w at 10 Hz: 9.32 ms of the filter that the firmware knows, 11.35 ms of this one
    assert compare_lag(lab).rms == pytest.approx(2.02, abs=0.2)
    assert compare_lag(lab_of(MICRON, tmp_path)).rms < 0.2
    healed = load_plan(with_remedy(load_bench(path), identify_timing(lab), tmp_path / "healed.toml")).stages
    assert healed.sensing.filter_ohm * healed.sensing.filter_farad == pytest.approx(32e3 * 0.43e-6, rel=0.01)
    assert healed.tremor.filter_cutoff_rad_s == pytest.approx(1.0 / (32e3 * 0.43e-6), rel=0.01)
    assert healed.tremor.loop_delay_s == pytest.approx(0.0017, abs=5e-5)
