"""Blind self-proof of the mismatch tool: own physics, sealed answers, honest table.

What lives here: physics of its own, cases drawn from it, answers sealed before the engine runs, the table.
What must not: an import of the tool's effects, twins or engine: `runner.py` alone calls ``diagnose`` on files. The
instrument's plant is the bench's own (``plants_bench``): it is what that twin is.
"""

from tools.research.prove.proof import ProofResult, prove

__all__ = ["ProofResult", "prove"]
