"""The decision engine: where a simulation and a recording differ, which physics is missing, and how sure that is."""
