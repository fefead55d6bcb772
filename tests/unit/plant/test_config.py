"""The [emulation] table: everything has a default, nothing unknown or impossible passes."""

import pytest
from pydantic import ValidationError

from sim_devices.config import EmulationConfig


def test_provider_and_seed_are_enough():
    config = EmulationConfig.model_validate({"provider": "sim_devices.register:provider", "seed": 1})
    assert config == EmulationConfig()
    with pytest.raises(ValidationError, match="frozen"):
        config.seed = 2


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"sede": 1}, "sede"),
        ({"hand": {"tremor_um": 50}}, "hand.tremor_um"),
        ({"seed": -1}, "seed"),
        ({"stack": {"damping": 0.0}}, "stack.damping"),
        ({"stack": {"slip_sum": 1.0}}, "stack.slip_sum"),
        ({"hand": {"reach_s": [3.0, 1.0]}}, "reach_s"),
        ({"hand": {"tremor_pp_um": float("nan")}}, "tremor_pp_um"),
        ({"amplifier": {"neutral_V": 120.0}}, "outside"),
        ({"instrument": {"positions_mm": [[0, 0, 0]]}}, "positions_mm"),
    ],
)
def test_what_is_wrong_is_named(table, message):
    with pytest.raises(ValidationError, match=message):
        EmulationConfig.model_validate(table)
