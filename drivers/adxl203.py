"""Describes the ADXL-203: two-axis accelerometer with analog outputs, read through a DAQ.

The firmware calibrates it from volts (``firmware_py.sensing``).
"""

from __future__ import annotations

from drivers.options import Adxl203Options, AnalogOptions
from drivers.registry import Driver

DRIVER = Driver(Adxl203Options, role="part", needs="daq", inputs=lambda options: tuple(options.channels.values()))
ANALOG = Driver(AnalogOptions, role="part", needs="daq", inputs=lambda options: (options.channel,))
"""A plain analog quantity, such as half the sensors' supply."""
