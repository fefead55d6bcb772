"""Stochastic model of a sensor at rest: Allan deviation and what it says of noise, flicker and walk.

What lives here: the curve, its identification, its picture. What must not: reading of files (``tools.calibrate.logs``).
"""
