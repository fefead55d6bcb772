"""A second process that takes the outputs to neutral when the firmware dies or stands still.

Here: the shared memory that carries the heartbeat, what the guardian does, its process, and the amplifier as the
firmware sees it beside a guardian. Not here: the decision to stop while the firmware is alive (control/safety.py).
"""
