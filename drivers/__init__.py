"""Bytes and volts to physical quantities and back: one file per device, one folder per family.

What lives here: protocols, registers and conversions as the manual has them, each with its section; what a bench file
may say of a device (``options``, ``specs``); data sheets (``sheets``).
What must not: vendor transports (``hal.backends``), ``time.*`` (the injected clock waits), estimation, emulation.
"""
