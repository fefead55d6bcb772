"""Serves people: the command line, reports, calibration, diagnostics and the mismatch engine.

What lives here: everything that a person starts or reads. What must not: anything the 1 kHz path needs.
"""
