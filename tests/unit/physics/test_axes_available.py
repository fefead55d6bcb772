"""Effects of vectors are not proposed for an output that is no axis of one."""

from __future__ import annotations

import numpy as np

from sim_devices.physics.catalogue import EFFECTS

SIGNALS = {f"specific_force_{a}": np.sin(np.arange(50.0) + i) for i, a in enumerate("xyz")}


def test_a_turn_needs_an_axis() -> None:
    turn = EFFECTS["misalignment"].variants[0]
    assert turn.available is not None
    assert turn.available(SIGNALS, "voltage_x") == ""
    assert "no axis" in turn.available(SIGNALS, "volts_0")
