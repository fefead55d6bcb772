"""Improves a bench by its diagnosis: experiments, remedies, and runs that decide whether a remedy is kept.

What lives here: the comparison of each part's measurement with the firmware's model (``parts``), the tip error of
runs (``figures``), the sequence of the whole (``heal``).
What must not: the identification of parts (``tools.calibrate``), the search for physics (``tools.mismatch.engine``).
"""
