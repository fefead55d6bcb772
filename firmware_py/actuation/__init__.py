"""Computes the drive voltages from the tremor at the tip: geometry, hysteresis, limits.

What lives here: inverse kinematics, inverse hysteresis with creep and lag, the border of the workspace, the compiled
``stage``. What must not: identification (``tools.calibrate``), the wire (``drivers.piezo``).
"""
