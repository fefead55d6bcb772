"""From a diagnosis to a better bench: experiments, remedies, and runs that decide whether a remedy is kept.

What lives here: what the lab measures of each part against what the firmware believes (``parts``), the tip error of
runs (``figures``), the order of it all (``heal``).
What must not: the identification of parts (``tools.calibrate``), the search for physics (``tools.mismatch.engine``).
"""
