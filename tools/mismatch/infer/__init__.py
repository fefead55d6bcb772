"""The mismatch engine on one score: what is named follows from a penalised predictive density with learned prices.

What lives here: the density of held-out residuals, the store of scored sets of effects, the search over sets, the
decision, and the learning of its constants. What must not: the name of any effect (an effect says what it is by its own
fields) and English (``report`` words what is found).
"""

from tools.mismatch.infer.run import diagnose

__all__ = ["diagnose"]
