"""Connects the instrument's emulated parts to the world: the inputs that they sense and the outputs that they drive."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from sim_devices.devices.ad5696r import Ad5696r
from sim_devices.devices.ads1115 import Ads1115
from sim_devices.devices.can_piezo_node import CanPiezoNode
from sim_devices.devices.can_stop_button import CanStopButton
from sim_devices.devices.can_telemetry_listener import CanTelemetryListener
from sim_devices.devices.di4108 import Di4108
from sim_devices.devices.e727 import E727
from sim_devices.registry import Device

if TYPE_CHECKING:
    from sim_devices.world import World


def _build_di4108(world: World, name: str, device: Mapping[str, Any]) -> None:
    volts = world.stimuli.volts(name, world.analog_V, 8)
    daq = Di4108(volts, fifo_samples=world.daq.fifo_samples, on_switches=world.switch_strap)
    world.add_serial(name, device, daq)


def _build_ads1115(world: World, name: str, device: Mapping[str, Any]) -> None:
    monitored = world.monitors.get(name)
    source = world.magnetometer_V if monitored is None else world.stack_monitor(*monitored)
    # outputs step within a conversion; the field does not
    world.add_chip(name, device, Ads1115(world.stimuli.volts(name, source, 4), looks=1 if monitored is None else 8))


def _build_dac(world: World, name: str, device: Mapping[str, Any]) -> None:
    dac = Ad5696r(on_output=world.amplify)
    world.stimuli.outputs(name, lambda: dac.output_V, 4)
    world.add_chip(name, device, dac)
    world.rest_at([volts * world.gain for volts in dac.output_V])


def _build_e727(world: World, name: str, device: Mapping[str, Any]) -> None:
    controller = E727(on_output=world.demand, measure_um=world.stimuli.axis(name, world.stroke_um))
    world.stimuli.outputs(name, lambda: controller.output_V, 4)
    world.add_serial(name, device, controller)
    world.rest_at(controller.output_V)


def _build_can_amplifier(world: World, name: str, device: Mapping[str, Any]) -> None:
    node = CanPiezoNode(on_output=world.demand, start_ns=world.epoch_ns)
    world.stimuli.outputs(name, lambda: node.output_V, 3)
    world.add_can(name, device, node)
    world.rest_at(node.output_V)


def _build_can_telemetry(world: World, name: str, device: Mapping[str, Any]) -> None:
    world.add_can(name, device, CanTelemetryListener())
    world.add_can(f"{name}.stop_button", device, CanStopButton(start_ns=world.epoch_ns))


DI4108 = Device(build=_build_di4108)
ADS1115 = Device(build=_build_ads1115)
DAC_AMPLIFIER = Device(build=_build_dac)
E727_CONTROLLER = Device(build=_build_e727)
CAN_AMPLIFIER = Device(build=_build_can_amplifier)
CAN_TELEMETRY = Device(build=_build_can_telemetry)
