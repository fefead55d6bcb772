"""Emulated benches for programs that are not ours: where each bus is, and what its parts sense.

What lives here: starting a world, the list of its buses, recorded columns as stimuli. What must not: drivers; whoever
uses these buses brings its own.
"""
