"""Settings of the machine that decide how late a loop wakes up: found, explained, and set where that is allowed.

What lives here: a table of settings, each with ``read``, ``explain`` and ``set``, over a tree of /dev, /proc and /sys.
What must not: settings of our own process (``firmware_py.scheduler.realtime``), or a decision of what a run does.
"""
