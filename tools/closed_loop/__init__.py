"""Simulates the closed loop without wires: the emulated world and the firmware's step as one compiled loop.

What lives here: the loop that joins ``sim_devices.plant`` to ``firmware_py.control.chain``, and what it hands back.
What must not: physics or stages of its own; a figure that ``micron run`` would compute otherwise.
"""
