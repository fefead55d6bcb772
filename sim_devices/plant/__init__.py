"""The plant to which the devices are connected: a hand that trembles, the body, sensors, stacks, the manipulator.

What lives here: the emulated truth in SI, stepped by compiled kernels, one unit per kind of instrument.
What must not: wire formats (``sim_devices.devices``), the firmware's equations.
"""
