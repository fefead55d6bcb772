"""Forward physics, one effect per file: compiled kernel, parameters with bounds and source, signature.

What lives here: the effects that the mismatch engine names and that twins are made of (``catalogue`` lists them).
What must not: the firmware's models or inverses; anything that knows a recording or a fit.
"""
