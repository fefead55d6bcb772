"""Exports corrected twins: as a Python module that needs numpy alone, as an FMU, as simulated columns.

What lives here: the writers of such files, and the numpy functions that they copy into them (``parts``).
What must not: the engine. An exported twin is written from the twin file's values and imports nothing of ours.
"""
