"""Holds the state and constants of ``hal.scan_time`` and its kernels. Importing this module loads no compiler."""

from __future__ import annotations

import numpy as np

SHIFT = 0.15
"""Distance of an arrival from the line that may indicate a clock step, as a fraction of the period.

USB is polled every 125 us, so arrivals that are all off the line by this much are not explained by jitter."""
SHIFT_ARRIVALS = 12
"""Number of successive arrivals that must be off the line; it exceeds the 10 ticks after which the tasks repeat."""
SHIFT_ALIKE = 8
"""Number of those arrivals that must agree within ``SHIFT_SPREAD``."""
SHIFT_SPREAD = 0.05
"""Largest spread of agreeing arrivals above the least late one, as a fraction of the period; a busy host has more."""


TIMELINE = np.dtype(
    [
        ("dt_ns", "f8"), ("window", "i8"), ("next", "i8"), ("arrivals", "i8"), ("origin_ns", "i8"), ("offset_ns", "f8"),
        ("skew_ns", "f8"), ("least_ns", "f8"), ("in_window", "i8"), ("off", "i8"), ("off_ns", "f8", (SHIFT_ARRIVALS,)),
    ]
)  # fmt: skip
"""State of a timeline. ``next``: number of the next scan; ``off``: arrivals in a row that are off the line, whose
lateness (ns) ``off_ns`` keeps, the newest overwriting the oldest."""
