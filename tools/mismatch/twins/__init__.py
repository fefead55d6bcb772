"""Twins: the simulators that recordings are compared with. ``make(recording)`` builds the one it names."""

from tools.mismatch.twins.base import Force, Run, Signal, Twin
from tools.mismatch.twins.make import make

__all__ = ["Force", "Run", "Signal", "Twin", "make"]
