"""The magnetometer's newest reading on its way into the frame, apart from what polls the magnetometer."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_py.frame import MAGNETOMETER_FRESH, MAGNETOMETER_RAW


def fill_field(frame: NDArray[np.float64], volts: NDArray[np.float64], fresh: NDArray[np.int64]) -> None:
    """Write ``volts`` (3,) into the frame's columns if they are ``fresh`` (1,), and mark whether they were. A compiled
    loop runs the same function."""
    frame[MAGNETOMETER_FRESH] = float(fresh[0])
    if fresh[0] != 0:
        for i in range(3):
            frame[MAGNETOMETER_RAW + i] = volts[i]
        fresh[0] = 0
