"""Implements the diagnostics of a bench: ports, buses, latency, staircases, golden transcripts.

What lives here: one file per command, thin over drivers and HAL. What must not: an output that moves without its
question or ``--yes``.
"""
