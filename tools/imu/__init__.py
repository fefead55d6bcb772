"""Evaluation of inertial sensors: offsets, stability, drift, noise, temperature (document 002, chapter 5).

What lives here: figures from a recording or from a bench, pictures of them. What must not: register access of its
own (``drivers.imu``).
"""
