"""Drives the outputs that move the tip: converts volts at the stacks to commands on I2C, serial or CAN.

What lives here: one driver per amplifier, each with arming, limits, the ramp to neutral and what read-back it has.
What must not: strokes, hysteresis or geometry (``firmware_py.actuation``).
"""
