"""Drives converters that are not the DAQ: one channel at a time over I2C, polled without waiting.

What lives here: one driver per chip. What must not: what the volts mean (the sensor's own driver says that).
"""
