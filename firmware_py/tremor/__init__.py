"""Estimates the tremor, now and over the delay of the loop, from the acceleration of the tip.

What lives here: estimators behind one interface (``estimator``), their prefilters and designs, detectors of what is
not tremor, the compiled ``stage``.
What must not: sensors (``sensing``), actuators, figures of merit (``tools.research.tremor``).
"""
