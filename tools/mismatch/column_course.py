"""Tells commands from readings by their values: a command is held or free of noise, a reading is noisy.

A staircase repeats each value exactly over tens of samples. A curve that a generator sweeps is smooth down to its last
digit. Noise is compared with the step to which the values are rounded, so that neither a unit nor a scale matters.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array

Course = Literal["held", "smooth", "noisy", ""]
"""The course of a column: a staircase, a curve without noise, a noisy reading, or none of these for certain."""
HELD = 10
"""Least samples of a step of a staircase. A noisy reading near a threshold of its rounding turns back within a few."""
MOST_SHORT = 0.1
"""Largest share of shorter steps: a staircase may be switched at any time now and then."""
ROUNDING = 1.0 / np.sqrt(12.0)
"""The rms of rounding, in steps of the rounding."""
MOST_DIGITS = 8
"""Significant digits from which on values are not rounded for print; single precision has no more."""
_THIRD = 0.6745 * np.sqrt(20.0)
"""Median size of the third difference of white noise, in its rms: the squares of 1, 3, 3, 1 add up to 20."""


def course_of(values: Array) -> Course:
    """Return the course of the values (n,) of a column; empty if they never change or if it cannot be told."""
    x = values[np.isfinite(values)]
    steps = np.diff(x)
    moves = np.flatnonzero(steps)
    if moves.size == 0 or x.size < 2 * HELD:
        return ""
    if moves.size * HELD <= x.size:
        return _course_of_steps(steps[moves], np.diff(moves))
    if moves.size * 2 <= x.size or np.unique(x).size == 2:
        return ""  # hidden by rounding, or a switch
    third = np.diff(x, 3)
    size, next_size = float(np.median(np.abs(third))), float(np.median(np.abs(np.diff(third))))
    rounding = ROUNDING * _step_of_rounding(x)
    noise = size / _THIRD
    # a further difference makes white noise larger, by 1.87, and a curve that is sampled densely enough smaller
    if next_size > size and noise > 2.0 * rounding:
        return "noisy"
    # rounding alone gives a ratio of 1, with the scatter of a median
    return "smooth" if next_size < size or noise < 1.2 * rounding else ""


def _step_of_rounding(x: Array) -> float:
    """Return the step to which values are rounded: of their largest one in print, or of the converter behind them."""
    largest = float(np.max(np.abs(x)))
    values = x[x != 0.0]
    decade = 10.0 ** np.floor(np.log10(np.abs(values)))
    digits = 1
    while digits < MOST_DIGITS:
        shift = 10.0 ** (digits - 1)
        if np.all(np.abs(np.round(values / decade * shift) / shift * decade - values) <= 1e-12 * np.abs(values)):
            break
        digits += 1
    printed = float(10.0 ** (np.floor(np.log10(largest)) - digits + 1))
    apart = np.diff(np.unique(x))
    apart = apart[apart > 1e-9 * largest]  # two results of one calculation may differ in their last bit
    if apart.size == 0:
        return printed
    cells = apart / np.min(apart)
    # a printed step of a converter is itself rounded
    is_lattice = bool(np.all(np.abs(cells - np.round(cells)) < 0.02))
    return max(printed, float(np.min(apart))) if is_lattice else printed


def _course_of_steps(jumps: Array, dwells: NDArray[np.int64]) -> Course:
    """Return the course of a column that mostly repeats its value: a staircase, or a slow curve that is rounded.

    The rounded curve moves by one step of its rounding each time, whenever the next one is due. A staircase has its own
    times, or jumps further.
    """
    if int(np.sum(dwells < HELD)) > MOST_SHORT * dwells.size:
        return ""
    sizes = np.abs(jumps)
    is_even_in_size = bool(np.max(sizes) < 1.5 * np.min(sizes))  # two steps of the rounding are twice one
    is_even_in_time = dwells.size == 0 or bool(np.ptp(dwells) <= 1)
    turns_each_time = bool(np.all(jumps[1:] * jumps[:-1] < 0))  # between two values
    return "smooth" if is_even_in_size and not is_even_in_time and not turns_each_time else "held"


def roles_of_courses(
    courses: Mapping[str, Course], named: Mapping[str, str], by_unit: Mapping[str, str]
) -> dict[str, Literal["input", "output"]]:
    """Return the roles that values tell, of the columns of ``courses`` whose name tells none.

    ``named`` and ``by_unit``: the role that the name, or else the unit, of each column tells. A held column is a
    command if another column is left to answer. Beside it noisy columns are readings, and smooth ones are commands if
    one is noisy: without it nothing says that this file has noise at all. Without a held column, values do not outweigh
    a unit: the encoder of a drive is smoother than the current in it.
    """
    held = [name for name, course in courses.items() if course == "held" and not named[name]]
    others = [name for name in courses if name not in held and named[name] != "input"]
    if held and not others:
        return {}
    free = [name for name in others if not named[name] and (held or not by_unit[name])]
    has_noise = any(courses[name] == "noisy" for name in (others if held else free))
    roles: dict[str, Literal["input", "output"]] = dict.fromkeys(held, "input")
    if has_noise:
        roles |= {name: "input" for name in free if courses[name] == "smooth"}
    if roles:
        roles |= dict.fromkeys((name for name in free if name not in roles), "output")
    return roles
