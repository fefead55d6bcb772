"""Emulated parts, a folder each: ``NAME/device.py`` holds ``DEVICE`` (``sim_devices.registry``).

What lives here: parts written from their data sheets. What must not: any import of a driver.
"""
