"""Joins the parts into an instrument: wiring, the loop, its tasks, and the supervisor that may stop it.

What lives here: who runs when (``tasks``), the pass of a tick (``loop``), what may end a run (``watch``,
``plausibility``, ``safety``) and what follows from a finding (``incidents``).
What must not: mathematics of a stage, bytes of a device.
"""
