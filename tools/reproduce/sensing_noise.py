"""Allan slopes of 000 Figs. 3.15 to 3.17 on simulated noise, and the placements of 004 sec. 3 optimised."""

from __future__ import annotations

import numpy as np

from tools.noise.allan import allan_curve, identify, slope
from tools.placement.configurations import micron_004_turned
from tools.placement.optimise import optimise
from tools.placement.space import space_004
from tools.placement.variance import angular_noise
from tools.reproduce.rows import Row

DENSITY_M_S2 = 110e-6 * 9.80665 / np.sqrt(2.0)
WALK = 2e-5
RAMP = 2e-7


def allan_slopes() -> list[Row]:
    """White noise of the data sheet, a weak random walk and the drift of a warming sensor, as the figures show them."""
    rng = np.random.default_rng(1)
    n = 12 * 3600
    white = DENSITY_M_S2 * rng.standard_normal(n)
    walk = WALK * np.cumsum(rng.standard_normal(n))
    long = allan_curve(white + walk + RAMP * np.arange(n), 1.0)
    steady = allan_curve((white + walk)[-4 * 3600 :], 1.0)
    short = allan_curve(DENSITY_M_S2 * np.sqrt(1000.0) * rng.standard_normal(300_000), 1000.0)
    model = identify(allan_curve(white + walk, 1.0))
    condition = "simulated: 110 ug/rtHz, K 2e-5 m/s^2/rt s, ramp 2e-7 m/s^3"
    rows = [
        Row(
            f"000, Fig. {figure}",
            what,
            "1",
            f"{condition}, {length}",
            published,
            found,
            "equal",
            "emulated",
            tolerance=tolerance,
            why="the figure prints no coefficients; the slope is what it shows",
        )
        for figure, what, length, published, found, tolerance in (
            ("3.15", "slope of the white part", "12 h at 1 Hz", -0.5, slope(long, 1.0, 16.0), 0.05),
            ("3.15", "slope of the trend", "12 h at 1 Hz", 1.0, slope(long, 4096.0, 16384.0), 0.25),
            ("3.16", "slope of the white part", "last 4 h", -0.5, slope(steady, 1.0, 16.0), 0.06),
            ("3.17", "slope", "300 s at 1 kHz", -0.5, slope(short, 0.001, 8.0), 0.05),
        )
    ]
    rows.append(
        Row(
            "ERRATA 34",
            "random walk read at tau = 3 over the one simulated",
            "1",
            condition,
            1.0,
            model.walk.value / WALK,
            "equal",
            "emulated",
            tolerance=0.4,
        )
    )
    return rows


def optimised_placements() -> list[Row]:
    """The space of 004 with the least noise that it allows."""
    condition = "004's space, 10 mm/s^2 per axis, six degrees of freedom observable"
    rows = [
        Row(
            "004, Table 1 (proposed: 0.78; Micron: 2.86)",
            f"vector noise, {packages} packages of {axes}, optimised",
            "rad/s^2",
            condition,
            goal,
            float(optimise(space_004(packages, axes)).noise[3]),
            "lower",
            "exact",
        )
        for packages, axes, goal in ((3, 2, 0.42), (6, 1, 0.35))
    ]
    rows.append(
        Row(
            "004, Table 1 (proposed: 0.78; Micron: 2.86)",
            "vector noise, Micron with the back packages turned by 45 degrees",
            "rad/s^2",
            condition,
            0.78,
            float(angular_noise(micron_004_turned(), 0.010)[3]),
            "lower",
            "exact",
        )
    )
    return rows
