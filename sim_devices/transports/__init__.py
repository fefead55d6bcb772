"""Transports that carry bytes between an emulated device and a driver: ptys, sockets, CAN, virtual time.

What lives here: carriers that put a sans-IO device behind a real port, and the lockstep that replaces them all in
virtual time. What must not: protocol or physics; a carrier passes on what it gets, when it is due.
"""
