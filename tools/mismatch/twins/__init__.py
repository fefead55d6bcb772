"""Twins: the simulators that recordings are compared with. ``make.make(recording)`` builds the one it names.

What lives here: a simulator per kind, each with its parameters, outputs and places for effects.
What must not: effects (``sim_devices.physics``), a judgement of the fit (``tools.mismatch.engine``).
Nothing is imported here: the vocabulary is read by programs that run no twin.
"""
