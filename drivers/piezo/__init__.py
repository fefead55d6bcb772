"""Outputs that move the tip: volts wanted to what an amplifier is told, on I2C, serial or CAN.

What lives here: one driver per amplifier, each with arming, limits, the ramp to neutral and what read-back it has.
What must not: strokes, hysteresis or geometry (``firmware_py.actuation``).
"""
