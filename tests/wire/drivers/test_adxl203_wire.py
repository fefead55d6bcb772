"""ADXL-203 against the figures of its data sheet."""

from __future__ import annotations

import pytest

from drivers.adxl203 import Adxl203
from hal.errors import BenchError

G = 9.80665


@pytest.mark.parametrize(
    ("volts", "supply_V", "force_g"),
    [(2.5, 5.0, 0.0), (3.5, 5.0, 1.0), (1.5, 5.0, -1.0), (2.75, 5.5, 0.0), (3.85, 5.5, 1.0), (1.35, 4.5, -1.0)],
)
def test_ratiometric_output(volts: float, supply_V: float, force_g: float):
    assert Adxl203({"x": 0}).specific_force(volts, supply_V) == pytest.approx(force_g * G, abs=1e-9)


@pytest.mark.parametrize(("volts", "saturated"), [(4.2, True), (4.19, False), (0.8, True), (0.81, False)])
def test_saturation_at_1_7_g(volts: float, saturated: bool):
    assert Adxl203({"x": 0}).saturated(volts) is saturated


def test_channels_follow_the_wiring():
    acc = Adxl203({"y": 2, "z": 3}, name="acc2")
    assert acc.daq_channels == (2, 3)
    assert [(c.name, c.unit) for c in acc.channels()] == [("acc2.y", "m/s^2"), ("acc2.z", "m/s^2")]
    assert acc.channels()[0].hi == pytest.approx(16.67, abs=0.01)
    with pytest.raises(BenchError):
        Adxl203({})
