"""Blind self-proof of the mismatch tool: own physics, sealed answers, honest table.

Nothing here imports the tool's effects, twins or engine: `runner.py` alone calls ``diagnose`` on files.
"""

from tools.mismatch.prove.proof import ProofResult, prove

__all__ = ["ProofResult", "prove"]
