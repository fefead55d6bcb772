"""Says what to record next: effects that channels can tell apart, and the input that separates models best.

What lives here: a twin before any recording (``situation``), responses to effects and their angles (``responses``,
``separable``), the structural analysis (``structure``), waveforms within limits (``limits``, ``waveforms``), the design
of an input (``models``, ``design``), its files (``write``).
What must not: the search for physics (``tools.mismatch.engine``), anything that moves an instrument.
"""
