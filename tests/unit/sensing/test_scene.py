"""The scene of the published tables: compiled and plain Python say the same."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

from firmware_py.frame import LAYOUT
from firmware_py.records import attributes
from firmware_py.sensing.config import SensingConfig
from firmware_py.sensing.stage import Sensing
from sim_devices.config import EmulationConfig
from sim_devices.plant.hand import SyntheticHand
from sim_devices.plant.kernel import NOISES, SLOW_NOISES, TRUTH_COLUMNS, begin
from sim_devices.plant.unit import build_unit, plant_arrays
from tests.unit.pure_python import without_compiler
from tools.research.reproduce import scene


def test_scene_kernel_and_python_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    config, n = EmulationConfig(unit=1, seed=1), 25
    rng = np.random.default_rng(3)
    noise, slow = rng.standard_normal((n, NOISES)), rng.standard_normal((n, SLOW_NOISES))
    results = []
    for compiled in (True, False):
        hand = SyntheticHand(config.hand, 1)
        nodes, parts, first = np.zeros((n, 18)), np.zeros((n, 6)), np.zeros(18)
        hand.start(first, np.zeros(6))
        hand.fill(nodes, parts)
        plant, state = plant_arrays(config, build_unit(config, 1), hand.frame)
        begin(plant, state, first, np.zeros(6), np.zeros(TRUTH_COLUMNS))
        firmware, frame, out = Sensing(SensingConfig(align_s=0.02)), LAYOUT.new_frame(), np.empty((n, scene.OUT))
        records = (firmware.state, firmware.params)
        if not compiled:
            without_compiler(monkeypatch)
            for name, module in list(sys.modules.items()):
                if name.startswith("sim_devices.plant") or module is scene:
                    for key, value in list(vars(module).items()):
                        if isinstance(value, Dispatcher):
                            monkeypatch.setattr(module, key, value.py_func)
            records = tuple(attributes(r) for r in records)
        scene.scene_kernel(plant, state, nodes, noise, slow, 0, *records, frame, out)
        results.append((out, frame))
    np.testing.assert_allclose(results[1][0], results[0][0], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(results[1][1], results[0][1], rtol=1e-9, atol=1e-12)
