"""File formats of other programs: one module per format, which reads its columns and writes a recording in it.

What lives here: netCDF-4, ASAM MDF 4, parquet, MCAP for viewers, and ``export``, which chooses by the ending of a name.
What must not: what the columns mean (``tools.mismatch``), the recording format itself (``firmware_py.recording``).
"""
