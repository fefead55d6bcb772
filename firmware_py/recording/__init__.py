"""Recording: ring, recorder process, MCAP files, recovery, export, replay. Format: docs/recording-format.md.

What lives here: all that turns frames into a file that survives a crash, and back.
What must not: waiting. The loop pushes and counts what did not fit.
"""
