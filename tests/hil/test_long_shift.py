"""A shift of eight hours (MICRON_SHIFT_S) in closed loop without wires: nothing drifts, nothing is lost, nothing grows.

Bytes, buses and supervision are not in it; ``test_long_run.py`` has those, for half an hour.
"""

from __future__ import annotations

import os

import numpy as np
import pytest

from firmware_py.frame import QUATERNION, TICK
from hal.bench import load_bench
from sim_devices.plant.kernel import TRUTH
from tests.conftest import DEFAULT_BENCH
from tests.hil.test_long_run import resident_mb
from tools.closed_loop.simulate import simulate

SECONDS = float(os.environ.get("MICRON_SHIFT_S", "28800"))
WINDOWS = 8
GROWTH_MB = 2.0
AT = {name: slice(at, at + n) for name, at, n in TRUTH}


def up(quaternions: np.ndarray) -> np.ndarray:
    """(n, 3) the world's z axis in the body frame, of quaternions body to world (ERRATA, section 5)."""
    w, x, y, z = quaternions.T
    return np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z], axis=1)


class Shift:
    """Sums over equal windows: left of the tremor, the tremor, error of the tilt."""

    def __init__(self) -> None:
        self.sums = np.zeros((WINDOWS, 4))
        self.ticks = 0
        self.memory: list[float] = []

    def see(self, truth: np.ndarray, frames: np.ndarray) -> None:
        n = len(frames)
        assert len(truth) == n
        np.testing.assert_array_equal(frames[:, TICK], np.arange(self.ticks, self.ticks + n))
        assert np.isfinite(frames).all()
        window = min(WINDOWS - 1, int(self.ticks * 1e-3 / SECONDS * WINDOWS))
        self.ticks += n
        if self.ticks < 5000:  # filters settle
            return
        left, there = (truth[:, AT[name]] - truth[:, AT["intended_m"]] for name in ("tip_m", "tip_rigid_m"))
        tilt = np.cross(up(frames[:, QUATERNION : QUATERNION + 4]), up(truth[:, AT["quaternion"]]))
        self.sums[window] += (
            n,
            np.sum((left - left.mean(0)) ** 2),
            np.sum((there - there.mean(0)) ** 2),
            np.sum(tilt**2),
        )
        if self.ticks // 60_000 > len(self.memory):
            self.memory.append(resident_mb())

    def figures(self) -> np.ndarray:
        """(WINDOWS, 3): rms left and rms there in um, within blocks of 256 ms; rms tilt error in mrad."""
        return np.sqrt(self.sums[:, 1:] / self.sums[:, :1]) * (1e6, 1e6, 1e3)


@pytest.mark.slow
@pytest.mark.timeout(0)
def test_the_last_hour_of_a_shift_is_like_the_first() -> None:
    shift = Shift()
    simulate(load_bench(DEFAULT_BENCH), SECONDS, on_block=shift.see)
    figures = shift.figures()
    print("\nleft um, tremor um, tilt error mrad, by eighths\n", np.round(figures, 3), f"\n{shift.ticks} ticks")
    assert shift.ticks >= SECONDS * 1000
    settled = shift.memory[len(shift.memory) // 4 :]
    assert not settled or max(settled) - settled[0] < GROWTH_MB
    part = figures[:, 0] / figures[:, 1]
    assert part.max() < 0.5
    np.testing.assert_allclose(part, np.median(part), rtol=0.25)  # as good at the end as at the beginning
    assert figures[-1, 2] < 1.5 * np.median(figures[:, 2])  # the attitude does not run away
