"""Twins: the simulators that recordings are compared with. ``make(recording)`` builds the one it names.

What lives here: a simulator per kind, each with its parameters, outputs and where effects may be put in.
What must not: effects (``sim_devices.physics``), a judgement of the fit (``tools.mismatch.engine``).
"""

from tools.mismatch.twins.base import Force, Run, Signal, Twin
from tools.mismatch.twins.make import make

__all__ = ["Force", "Run", "Signal", "Twin", "make"]
