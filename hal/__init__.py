"""Abstracts the hardware: contracts, units, errors, clock and bench description.

What lives here: the contracts of buses and devices, and the adapters (``hal.backends``) that fulfil them.
What must not: anything that knows a device, the firmware, or whether something is emulated.
Importing ``hal`` imports no vendor package and nothing heavy.
"""
