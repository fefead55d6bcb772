"""Watches with a twin: detects when and where channels depart from the twin, at a stated false-alarm rate.

What lives here: the sequential test (``detector``), its calibration on a reference part (``reference``), its bounds
(``bounds``), the twin beside a recording or a running instrument.
What must not: the physics of twins, reasons of a difference (``tools.mismatch.engine``).
"""
