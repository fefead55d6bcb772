"""Arrays for a compiled caller are the same world as the instrument that devices look at."""

from __future__ import annotations

import numpy as np
import pytest

from sim_devices.config import EmulationConfig
from sim_devices.plant.blocks import PlantBlocks
from sim_devices.plant.hand import SyntheticHand
from sim_devices.plant.instrument import Instrument
from sim_devices.plant.kernel import STEPS_PER_MS, advance

CONFIG = EmulationConfig(seed=5)
MS = 64


def test_same_draws_same_world() -> None:
    world = PlantBlocks(CONFIG, SyntheticHand(CONFIG.hand, CONFIG.seed), 2 * MS, ms=32)
    row = 1
    for _ in range(2):
        world.next_block()
        for first in range(0, 32 * STEPS_PER_MS, 40):  # pieces, as a loop with a command in the middle
            steps = first, min(first + 40, 32 * STEPS_PER_MS)
            row = advance(world.plant, world.state, world.block, steps, world.truth, row)
    instrument = Instrument(CONFIG, CONFIG.seed, SyntheticHand(CONFIG.hand, CONFIG.seed), unit=CONFIG.unit)
    instrument.advance_to(MS * 1_000_000)
    wanted, found = instrument.truth(), world.truth_columns(row)
    assert row == MS + 1
    assert wanted.keys() == found.keys()
    for name, column in wanted.items():
        assert np.array_equal(column, found[name]), name
    assert np.array_equal(world.state[0]["daq_V"], instrument.analog_V)


def test_a_block_is_made_of_whole_draws() -> None:
    with pytest.raises(ValueError, match="multiple of 16 ms"):
        PlantBlocks(CONFIG, SyntheticHand(CONFIG.hand, CONFIG.seed), MS, ms=20)
