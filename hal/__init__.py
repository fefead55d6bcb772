"""The hardware abstraction: contracts, units, errors, clock and bench description.

What lives here: what a driver may assume of a bus, and the adapters (``hal.backends``) that make it so.
What must not: anything that knows a device, the firmware, or whether something is emulated.
Importing ``hal`` imports no vendor package and nothing heavy.
"""
