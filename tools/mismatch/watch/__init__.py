"""A twin that watches: when and where recorded channels leave what their twin says, at a stated false-alarm rate.

What lives here: the sequential test (``detector``), what it takes from a reference part (``reference``), its bounds
(``bounds``), the twin beside a recording or a running instrument.
What must not: the physics of twins, reasons of a difference (``tools.mismatch.engine``).
"""
