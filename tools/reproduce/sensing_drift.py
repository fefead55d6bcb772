"""Integration drift orders (000 Fig. 3.1, sec. 2.1): how position and tilt errors grow with time."""

from __future__ import annotations

import numpy as np

from tools.reproduce.rows import Row

G = 9.80131
DT_S = 1e-3


def growth_order(seconds: float, integrations: int, through_gravity: bool) -> float:
    """Slope of log position error over log time for a constant error of 1 mg or of 1e-4 in rate or alpha.

    The error goes through ``integrations`` steps of the ordinary strapdown sums; ``through_gravity`` turns an
    attitude error into an acceleration error first.
    """
    n = round(seconds / DT_S)
    value = np.full(n, 1e-6)
    for _ in range(integrations):
        value = np.cumsum(value) * DT_S
    if through_gravity:
        value = np.cumsum(np.cumsum(G * np.sin(value)) * DT_S) * DT_S
    t = (np.arange(n) + 1) * DT_S
    late = t > 0.1 * seconds
    return float(np.polyfit(np.log(t[late]), np.log(value[late]), 1)[0])


def rows() -> list[Row]:
    """Bias of an accelerometer, of a rate, of an angular acceleration."""
    cases = (
        ("accelerometer bias", 2, False, 2.0),
        ("rate bias (gyroscope), through gravity", 1, True, 3.0),
        ("angular acceleration bias, through gravity", 2, True, 4.0),
    )
    return [
        Row(
            "000, sec. 2.1, Fig. 3.1",
            f"order of position drift in time, {what}",
            "1",
            "constant error, 10 s at 1 kHz",
            order,
            growth_order(10.0, integrations, gravity),
            "equal",
            "exact",
            tolerance=0.01,
        )
        for what, integrations, gravity, order in cases
    ]
