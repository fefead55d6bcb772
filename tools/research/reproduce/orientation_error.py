"""The error definition of BROAD (Laidig et al., Data 6 (7), 2021)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array


def product(p: Array, q: Array) -> Array:
    """Hamilton products of rows, scalar first."""
    pw, px, py, pz = p.T
    qw, qx, qy, qz = q.T
    return np.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        axis=1,
    )


def east_north_up(quaternion: Array) -> Array:
    """Rotate from a world with x to north to one with x to east: by 90 degrees about up."""
    half = np.sqrt(0.5)
    return product(np.tile([half, 0.0, 0.0, half], (len(quaternion), 1)), quaternion)


def rms_errors_deg(estimate: Array, reference: Array, counts: NDArray[np.bool_]) -> tuple[float, float, float]:
    """Total, heading and inclination rms in degrees over the rows that count and have a reference."""
    use = counts & np.all(np.isfinite(reference), axis=1)
    inverse = reference[use] / np.linalg.norm(reference[use], axis=1)[:, None] * np.array([1.0, -1.0, -1.0, -1.0])
    w, _, _, z = product(estimate[use], inverse).T
    total = 2.0 * np.arccos(np.clip(np.abs(w), 0.0, 1.0))
    heading = 2.0 * np.arctan2(np.abs(z), np.abs(w))
    inclination = 2.0 * np.arccos(np.clip(np.hypot(w, z), 0.0, 1.0))
    total_deg, heading_deg, inclination_deg = (
        float(np.degrees(np.sqrt(np.mean(angle**2)))) for angle in (total, heading, inclination)
    )
    return total_deg, heading_deg, inclination_deg
