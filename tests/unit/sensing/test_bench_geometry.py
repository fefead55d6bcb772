"""The firmware believes the geometry that the emulated instrument of the same bench file has."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from firmware_py.control.plan import load_plan
from hal.bench import load_bench
from sim_devices.config import EmulationConfig
from sim_devices.plant.sensors import DIRECTION, LOCATION

BENCHES = Path(__file__).parents[3] / "benches"


@pytest.mark.parametrize("name", ["micron", "micron-can", "micron-e727"])
def test_positions_tip_and_channels_agree(name: str) -> None:
    bench = load_bench(BENCHES / f"{name}.toml")
    sensing = load_plan(bench).stages.sensing
    emulation = bench.description.emulation
    drawn = EmulationConfig.model_validate({k: v for k, v in emulation.items() if k != "provider"}).instrument
    np.testing.assert_allclose(np.array(sensing.positions_m), np.array(drawn.positions_mm) * 1e-3, atol=1e-12)
    np.testing.assert_allclose(sensing.tip_m, np.array(drawn.tip_mm) * 1e-3, atol=1e-12)
    places = np.array(drawn.positions_mm)[list(LOCATION)] * 1e-3
    np.testing.assert_allclose(sensing.axis_positions(), places, atol=1e-12)
    # the calibrated directions are within the assembly's tolerance of the drawn ones
    assert len(DIRECTION) == len(sensing.axes)
    assert all(abs(sensing.axes[i][DIRECTION[i]]) > np.cos(np.radians(3.0)) for i in range(len(DIRECTION)))
