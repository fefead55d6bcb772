"""Bench files that ship with the package: which devices there are and what is emulated.

What lives here: a TOML file per bench, and calibration of the emulated instrument. What must not: code.
"""
