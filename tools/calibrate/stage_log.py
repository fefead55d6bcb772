"""Reads rotary-stage recordings: columns of sensors beside the two stage angles, one row or more per pose.

Angles: ``alpha_deg``/``beta_deg``, ``alpha_rad``/``beta_rad``, or the lab's ``stage_y_rad``/``stage_z_rad``. Rows in
a run at one pair of angles are one pose: the mean of its last 5 s (Ang 2004 sec. 3.2.1.7) counts.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hal.arrays import Array
from tools.calibrate.logs import load_log, what_there_is
from tools.errors import InputError

ANGLES = (("alpha_deg", "beta_deg"), ("alpha_rad", "beta_rad"), ("stage_y_rad", "stage_z_rad"))
AVERAGE_S = 5.0
SAME_RAD = np.radians(0.02)


@dataclass(frozen=True)
class StageLog:
    """``attitude`` (n, 3, 3) body to world and the mean of every column at each of n poses."""

    path: Path
    attitude: Array
    columns: dict[str, Array]

    def matrix(self, names: tuple[str, ...]) -> Array:
        """(n, len(names)); ``InputError`` names a column that is missing."""
        for name in names:
            if name not in self.columns:
                raise InputError(f"{self.path}: no column '{name}'; {what_there_is(self.columns)}")
        return np.stack([self.columns[name] for name in names], axis=1)


def stage_attitude(alpha: Array, beta: Array) -> Array:
    """Return the attitude C_WB (n, 3, 3) = R_y(alpha) R_z(beta) from angles (n,) in rad."""
    ca, sa, cb, sb = np.cos(alpha), np.sin(alpha), np.cos(beta), np.sin(beta)
    zero = np.zeros_like(ca)
    rows = [[ca * cb, -ca * sb, sa], [sb, cb, zero], [-sa * cb, sa * sb, ca]]
    return np.moveaxis(np.array(rows), 2, 0)


def load_stage_log(path: Path, rate_hz: float | None = None) -> StageLog:
    """Any recording that ``load_log`` reads, with the angles of two stages."""
    log = load_log(path, rate_hz)
    names = next((pair for pair in ANGLES if all(name in log.columns for name in pair)), None)
    if names is None:
        wanted = " or ".join("/".join(pair) for pair in ANGLES)
        raise InputError(
            f"{log.path}: no stage angles ({wanted}); {what_there_is(log.columns)}. Without stages: micron bench "
            "guides you through poses by hand"
        )
    angles = log.matrix(names)
    if names[0].endswith("_deg"):
        angles = np.radians(angles)
    moved = np.any(np.abs(np.diff(angles, axis=0)) > SAME_RAD, axis=1)
    bounds = np.concatenate([[0], np.flatnonzero(moved) + 1, [len(angles)]])
    longest = int(np.max(np.diff(bounds)))
    if longest > 1:
        last = max(1, round(AVERAGE_S * log.need_rate()))
        starts = np.maximum(bounds[:-1], bounds[1:] - last)
    else:
        starts = bounds[:-1]
    columns = log.matrix(tuple(log.columns))
    means = np.array([columns[a:b].mean(axis=0) for a, b in zip(starts, bounds[1:], strict=True)])
    turned = angles[bounds[:-1]]
    return StageLog(
        log.path,
        stage_attitude(turned[:, 0], turned[:, 1]),
        {name: means[:, i] for i, name in enumerate(log.columns)},
    )
