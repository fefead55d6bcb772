"""The decision engine: where a simulation and a recording differ, which physics is missing, and how sure that is.

What lives here: locating, screening, fitting, comparing on held-out data, pruning, and the result as data.
What must not: effects (``sim_devices.physics``), simulators (``tools.mismatch.twins``), words for people (``report``).
"""
