"""Finds where a simulation and a recording differ, which physics the simulation lacks, and what modelling it gains.

What lives here: recordings of the contract, twins, the engine that decides, reports, the blind proof, the interface for
notebooks (``from tools.mismatch import Recording, Twin, diagnose``; the import loads numpy and no engine).
What must not: physics of its own; effects are in ``sim_devices.physics``, and ``prove`` shares none of them.
"""

from tools.mismatch.notebook import Diagnosis, Recording, Twin, diagnose

__all__ = ["Diagnosis", "Recording", "Twin", "diagnose"]
