"""Emulated devices, the physics behind them, and the world that steps both.

What lives here: wire faces written from datasheets and manuals, forward physics, transports that carry them.
What must not: an import of ``drivers``, ``firmware_py`` or ``tools``; the firmware's equations.
"""
