"""Faults on purpose, between a driver and its port: wrap any port, real or emulated, and count what was done."""

from hal.middleware.faults.can import FaultCan
from hal.middleware.faults.i2c import FaultI2c
from hal.middleware.faults.plan import FaultCounts, FaultPlan
from hal.middleware.faults.serial import FaultSerial

__all__ = ["FaultCan", "FaultCounts", "FaultI2c", "FaultPlan", "FaultSerial"]
