"""Identifies parameters from calibration recordings and writes the tables that the firmware loads.

What lives here: fits with intervals, conditions and what is missing. What must not: the models themselves, which are
the firmware's (``firmware_py``), so that what is identified is what runs.
"""
