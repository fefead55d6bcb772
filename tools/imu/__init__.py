"""Evaluates inertial sensors: offsets, stability, drift, noise, temperature (Erat 2018, chapter 5).

What lives here: figures from a recording or from a bench, pictures of them. What must not: register access of its
own (``drivers.imu``).
"""
