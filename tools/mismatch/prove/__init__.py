"""Blind self-proof of the mismatch tool: own physics, sealed answers, honest table.

Nothing here imports the tool's effects, twins or engine: `runner.py` alone calls ``diagnose`` on files. The
instrument's plant is the bench's own (``plants_bench``): it is what that twin is.
"""

from tools.mismatch.prove.proof import ProofResult, prove

__all__ = ["ProofResult", "prove"]
