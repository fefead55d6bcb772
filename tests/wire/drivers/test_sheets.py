"""Every driver has a sheet, and says the same as its sheet."""

from __future__ import annotations

from typing import Any

import pytest

from drivers.adc.ads1115 import Ads1115
from drivers.can_telemetry import CanTelemetry
from drivers.daq.di4108 import Di4108
from drivers.hmc2003 import Hmc2003
from drivers.imu.bmx055 import Bmx055
from drivers.imu.lsm6ds3 import Lsm6ds3
from drivers.imu.mpu6050 import Mpu6050
from drivers.motion_card import MotionCard
from drivers.piezo.can_amplifier import CanAmplifier
from drivers.piezo.dac_amplifier import DacAmplifier
from drivers.piezo.e727 import E727
from drivers.registry import BUILT_IN
from hal.clock import VirtualClock
from hal.types import ScanConfig
from tests.wire.drivers.scripted_ports import ScriptedCan, ScriptedI2c, ScriptedSerial
from tests.wire.drivers.sheets import load_sheet, names

# a bare voltage, any of NI's devices, dividers in front of an ADC, a part of another sheet
NOT_PARTS = {"analog", "nidaqmx", "nidaqmx_ao", "amplifier_monitor", "ble_motion_card"}

# the firmware reads the volts of an ADXL-203 through the DAQ; the part has no driver object
PARTS = [name for name in names() if name != "adxl203"]


class Strap:
    def write_digital(self, bits: int) -> None:
        pass


def drivers() -> dict[str, Any]:
    clock = VirtualClock()
    i2c, can, serial = ScriptedI2c([]), ScriptedCan(clock), ScriptedSerial(clock, [])
    daq = Di4108(serial, clock)
    daq._command = lambda text: None  # type: ignore[method-assign]
    daq.stop = lambda: None  # type: ignore[method-assign]
    daq.configure(ScanConfig(1000.0, tuple(range(8)), (5.0,) * 8))
    adc = Ads1115(i2c, clock)
    return {
        "di4108": daq,
        "ads1115": adc,
        "hmc2003": Hmc2003(adc, Strap(), clock),
        "dac_amplifier": DacAmplifier(i2c, clock),
        "e727": E727(serial, clock),
        "can_amplifier": CanAmplifier(can, clock),
        "can_telemetry": CanTelemetry(can, clock),
        "mpu6050": Mpu6050(i2c, clock),
        "lsm6ds3": Lsm6ds3(i2c, clock),
        "bmx055": Bmx055(i2c, clock),
        "motion_card": MotionCard(serial, clock),
    }


def test_every_driver_of_the_bench_file_has_a_sheet():
    assert set(names()) == set(BUILT_IN) - NOT_PARTS


@pytest.mark.parametrize("name", PARTS)
def test_sheet_and_driver_agree(name: str):
    sheet = [c.info() for c in load_sheet(name).channels]
    driver = list(drivers()[name].channels())
    assert [(c.name, c.unit) for c in sheet] == [(c.name.rpartition(".")[2], c.unit) for c in driver]
    for said, done in zip(sheet, driver, strict=True):
        assert (said.lo, said.hi, said.epsilon) == pytest.approx((done.lo, done.hi, done.epsilon), rel=1e-9)


@pytest.mark.parametrize("name", PARTS)
def test_two_instances_share_nothing(name: str):
    """No module-level state: what one instance is told, another does not know."""
    one, other = drivers()[name], drivers()[name]
    shared = [
        key
        for key, value in vars(one).items()
        if isinstance(value, (list, dict, bytearray, set)) and value is vars(other)[key]
    ]
    assert shared == []
