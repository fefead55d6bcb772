"""Drives inertial chips on I2C: identity, reset, ranges, bursts of one instant, offsets, self-test.

What lives here: a driver and a register map per chip, fields declared from the data sheet with its page.
What must not: attitude (``firmware_py.sensing``), calibration from recordings (``tools.imu``).
"""
