"""Drives converters that are not the DAQ: one channel at a time over I2C, polled without waiting.

What lives here: one driver per chip. What must not: the conversion of volts to a quantity (the sensor's own driver).
"""
