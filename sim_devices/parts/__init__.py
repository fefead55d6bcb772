"""Emulated parts by name (``sim_devices.registry``): a folder each, ``NAME/device.py`` with ``DEVICE``, and our own.

What lives here: how a part hangs on the world. What must not: any import of a driver.
"""
