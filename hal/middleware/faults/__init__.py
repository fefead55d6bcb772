"""Injects faults between a driver and its port: it wraps any port, real or emulated, and counts its faults.

What lives here: a wrapper per kind of port, and the plan that says what happens when.
What must not: the catalogue of faults and their judgement (``tools.research.faults``), faults behind the wire
(``sim_devices``).
"""

from hal.middleware.faults.can import FaultCan
from hal.middleware.faults.i2c import FaultI2c
from hal.middleware.faults.plan import FaultCounts, FaultPlan
from hal.middleware.faults.serial import FaultSerial

__all__ = ["FaultCan", "FaultCounts", "FaultI2c", "FaultPlan", "FaultSerial"]
