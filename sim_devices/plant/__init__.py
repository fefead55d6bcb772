"""What the devices are connected to: a hand that trembles, the body, sensors, stacks, the manipulator.

What lives here: the emulated truth in SI, stepped by compiled kernels, one unit per kind of instrument.
What must not: wire formats (``sim_devices.devices``), the firmware's equations.
"""
