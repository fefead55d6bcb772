"""Draw one physical instrument from the configuration and a seed, as the plain arrays that the kernel runs on."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_devices.config import EmulationConfig
from sim_devices.plant.kernel import NODE_S, PLANT, STATE, STEP_S
from sim_devices.plant.manipulator import ManipulatorUnit, manipulator_unit, tip_displacement
from sim_devices.plant.sensors import SensorUnit, field_gauss, sensor_unit
from sim_devices.plant.stack import StackUnit, drive_channel, stack_unit

_AMBIENT_S = 600.0
_SUPPLY_S = 10.0
_BOARD_S = 60.0


@dataclass(frozen=True)
class Unit:
    """Holds the parameters of one instrument, which the seed draws."""

    stacks: tuple[StackUnit, StackUnit, StackUnit]
    manipulator: ManipulatorUnit
    sensors: SensorUnit


def build_unit(config: EmulationConfig, seed: int) -> Unit:
    return Unit(
        stacks=(
            stack_unit(config.stack, seed, 0),
            stack_unit(config.stack, seed, 1),
            stack_unit(config.stack, seed, 2),
        ),
        manipulator=manipulator_unit(config.manipulator, seed),
        sensors=sensor_unit(config.sensors, config.instrument, seed, STEP_S),
    )


def start_temperature_C(config: EmulationConfig) -> float:
    """Return the temperature in degC of the sensor board and the stacks at the start of the run."""
    e = config.environment
    return e.ambient_C + e.warm_up_K * (1.0 - math.exp(-e.on_since_s / e.warm_up_s))


def plant_arrays(config: EmulationConfig, unit: Unit, frame: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
    """Return one-row structured arrays PLANT and STATE, at rest at neutral. ``frame`` (3, 3): attitude of the hand."""
    plant, state = np.zeros(1, PLANT), np.zeros(1, STATE)
    p, s = plant[0], state[0]
    for i, stack in enumerate(unit.stacks):
        channel, channel_state = drive_channel(stack, config.amplifier, STEP_S, start_temperature_C(config))
        p["channel"][i], s["channel"][i] = channel[0], channel_state[0]
    m, sensors, e = unit.manipulator, unit.sensors, config.environment
    p["circle_m"], p["shaft_m"], p["lever"] = m.circle_m, m.shaft_m, m.lever
    p["mount"], p["rest_m"], p["play_m"] = m.mount, m.rest_m, m.play_m
    tip_displacement(m.rest_m, m.circle_m, m.shaft_m, p["rest_tip_m"])
    p["frame"], p["gravity"] = frame, e.gravity_m_s2
    p["arm_m"] = sensors.positions_m - np.array(config.instrument.tip_mm) * 1e-3
    p["accelerometer"] = sensors.accelerometers
    p["supply_V"], p["supply_wander_V"] = sensors.supply_V, config.sensors.supply_wander_mV * 1e-3
    p["supply_keep"], p["ambient_keep"] = math.exp(-NODE_S / _SUPPLY_S), math.exp(-NODE_S / _AMBIENT_S)
    p["board_lag"] = -math.expm1(-NODE_S / _BOARD_S)
    p["divider"], p["temperature_offset_K"] = sensors.divider, sensors.temperature_offset_K
    p["ambient_C"], p["ambient_wander_K"] = e.ambient_C, e.ambient_wander_K
    p["warm_up_K"], p["warm_up_s"], p["on_since_s"] = e.warm_up_K, e.warm_up_s, e.on_since_s
    p["field_G"], p["magnetometer"] = field_gauss(e), sensors.magnetometer
    p["magnetometer_offset_V"], p["hard_iron_G"] = sensors.magnetometer_offset_V, sensors.hard_iron_G
    p["piezo_G_per_A"] = sensors.piezo_G_per_A
    p["magnetometer_noise_V"] = config.sensors.magnetometer_noise_uG * 1e-6
    p["daq_gain"], p["daq_offset_V"] = sensors.daq_gain, sensors.daq_offset_V
    p["daq_noise_V"] = config.sensors.daq_noise_uV * 1e-6
    p["daq_delay_s"], p["sense_s"] = config.daq.delay_ms * 1e-3, STEP_S
    s["demand_V"], s["strap"] = config.amplifier.neutral_V, 1.0
    return plant, state
