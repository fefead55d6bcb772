"""Runs any instrument: the loop, the findings that stop it, recorder and page, and the report of the run.

What lives here: everything that two instruments have in common. An instrument is a table of tasks, a function that
opens its devices, and a report (``instrument.py`` has the protocols). ``tasks.py`` defines a row of the table; the
tables themselves are in ``firmware_py/control/tasks.py`` and ``firmware_py/endoscope/instrument.py``, and
``firmware_py/frame.py`` lists every recorded quantity with its unit.
What must not: a sensor, an estimator, a device of one instrument (``firmware_py.control``, ``firmware_py.endoscope``).
"""
