"""Takes the outputs to neutral from a second process when the firmware dies or stands still.

What lives here: the heartbeat in shared memory, the guardian's state machine and its process, and the amplifier that
the firmware uses beside a guardian. The guardian acts when no command has come for ``[firmware.safety] guardian_ms``.
What must not: the decision to stop while the firmware is alive (``firmware_py.run.safety``).
"""
