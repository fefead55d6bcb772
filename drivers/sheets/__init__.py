"""Data sheets of the drivers: what a part measures or moves, in which unit and range, and how long it may take.

People read them; a test holds them against what the drivers say. One TOML file per driver.
What lives here: facts of a part. What must not: what a bench makes of it (channels, wiring: the bench file).
"""
