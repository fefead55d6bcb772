"""Wrappers around a port that look like the port: traces, sharing, faults on purpose.

What lives here: anything that may sit between a driver and any adapter, real or emulated, and change or watch bytes.
What must not: knowledge of a device's protocol. A wrapper keeps the contract of ``hal.contracts`` whole.
"""
