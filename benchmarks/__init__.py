"""Speed, side by side in one run: ratios are the result, absolute times belong to the machine.

What lives here: one file per comparison, and the yardstick in C. What must not: a threshold of a test (``tests/perf``).
"""
