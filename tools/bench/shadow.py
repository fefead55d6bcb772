"""Runs another attitude filter beside that of the firmware: the same raw inputs through a second sensing stage, here in
the server, so that two filters can be looked at side by side without the firmware knowing."""

from __future__ import annotations

import asyncio
import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_py.control.stages import StageConfigs
from firmware_py.frame import LAYOUT, QUATERNION, STATUS, VOLTS, FrameStatus
from firmware_py.sensing.config import SensingConfig, attitude_methods
from firmware_py.sensing.stage import Sensing
from tools.errors import InputError

_GIVEN_BITS = int(FrameStatus.GAP | FrameStatus.STALE)
MAX_ROWS = 200
"""Followed per call; a server that was late skips, as the filter coasts over gaps."""


class Shadow:
    """Runs one further attitude filter."""

    def __init__(self, config: SensingConfig) -> None:
        self.method = config.attitude_method
        self._sensing = Sensing(config)
        self._frame = LAYOUT.new_frame()
        self._sensing.step(self._frame)
        self._sensing.reset()
        self._frame[:] = 0.0

    def follow(self, rows: NDArray[np.float64]) -> None:
        """Filter ``rows`` (n, columns) of the running firmware."""
        for row in rows[-MAX_ROWS:]:
            self._frame[:VOLTS] = row[:VOLTS]
            self._frame[STATUS] = int(row[STATUS]) & _GIVEN_BITS
            self._sensing.step(self._frame)

    @property
    def quaternion(self) -> list[float]:
        """Return the attitude as a quaternion (4,), scalar first, body to world."""
        return self._frame[QUATERNION : QUATERNION + 4].tolist()


def check_method(method: str) -> None:
    """Raise ``InputError`` if no attitude filter has this name."""
    if method not in attitude_methods():
        raise InputError(f"{method!r} is not an attitude filter; there are {', '.join(attitude_methods())}")


async def make_shadow(metadata: dict[str, Any], method: str) -> Shadow:
    """Return a shadow of the running firmware with another ``method``. Raises ``InputError`` for an unknown method."""
    check_method(method)
    if not metadata:
        raise InputError("no firmware is running")
    if "stages" not in metadata:
        raise InputError("this instrument's filter is [firmware] fusion of its bench file; there is none beside it")
    configs = StageConfigs.from_dict(json.loads(metadata["stages"]), "running firmware")
    config = configs.sensing.model_copy(update={"attitude_method": method})
    return await asyncio.to_thread(Shadow, config)
