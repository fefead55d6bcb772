"""Provides the steps of a diagnosis: noise floors, splits, screening, fits, intervals, localisation, and the report.

What lives here: locating, screening, fitting, comparing on held-out data, pruning, and the result as data.
What must not: effects (``sim_devices.physics``), simulators (``tools.mismatch.twins``), words for people (``report``).
"""
