"""The drivers of all three chips on the emulated bus in process; test_i2c_level_c has the same on the honest bus."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import pytest

from hal.clock import VirtualClock
from hal.contracts import I2cBus
from sim_devices.lockstep_world import LockstepWorld
from sim_devices.register import provider
from tests.contract.imu_contract import CHIPS, DESCRIPTION, check_imu


@pytest.mark.parametrize("name", CHIPS)
def test_drivers_on_the_emulated_chips(tmp_path: Path, name: str) -> None:
    clock = VirtualClock()
    world = provider(DESCRIPTION, clock=clock, runtime_dir=tmp_path, hand_file=None, hand_scale=None)
    assert isinstance(world, LockstepWorld)
    check_imu(name, cast(I2cBus, world.endpoint("i2c0")), clock)
