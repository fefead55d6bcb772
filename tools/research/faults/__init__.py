"""The fault campaign: what is done to the instrument, what it answered, and the table of both.

Here: the catalogue of faults, one run with one fault, the judgement, the page. Not here: how a fault is made
(hal/middleware/faults on a port, sim_devices/faults in the emulated world) or detected (firmware_py/control).
"""
