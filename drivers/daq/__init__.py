"""Drives data acquisition devices: scans of all inputs at one instant, stamped with the device's clock, losses counted.

What lives here: one driver per DAQ; counts go out, volts are ``counts * lsb_V``.
What must not: calibration of sensors, filtering.
"""
