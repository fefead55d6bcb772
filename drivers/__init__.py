"""Converts bytes to volts and physical quantities and back: one file per device, one folder per family.

The instrument's accelerometers and magnetometer stay in volts here; the firmware calibrates them.
What lives here: protocols, registers and conversions as the manual has them, each with its section; the keys of a bench
file (``options``, ``specs``).
What must not: vendor transports (``hal.backends``), ``time.*`` (the injected clock waits), estimation, emulation.
"""
