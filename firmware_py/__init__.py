"""The instrument: scheduler, sensing -> tremor -> actuation, safety, recording.

What lives here: everything that runs a thousand times a second, in the order in which a sample passes.
What must not: wire formats (drivers), people (tools), or any knowledge of emulation.
"""
