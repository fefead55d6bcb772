"""A delay of several time constants is found although a drift is missing, too."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.recording_text import channel
from tools.mismatch.engine.pose import pose
from tools.mismatch.engine.screen import places
from tools.mismatch.engine.vary import added
from tools.mismatch.recording_load import load

RATE_HZ, DELAY_S = 10.0, 3.4


def test_a_delay_of_many_time_constants_is_found(tmp_path: Path) -> None:
    rng, n = np.random.default_rng(8), 6000
    u = np.concatenate([np.full(rng.integers(15, 200), rng.uniform(10.0, 90.0)) for _ in range(n // 15)])[:n]
    late = int(DELAY_S * RATE_HZ)
    seen = np.concatenate([np.full(late, u[0]), u])
    decay, x, y = np.exp(-0.8 / RATE_HZ), 0.12 * u[0], np.empty(n)
    for k in range(n):
        y[k] = x
        x = decay * x + (1.0 - decay) * 0.12 * seen[k]
    y += 0.45 * (1.0 - np.exp(-np.arange(n) / RATE_HZ / 170.0))
    np.savez(tmp_path / "data.npz", u=u, y=y + rng.normal(0.0, 0.04, n))
    (tmp_path / "recording.toml").write_text(
        f"""format = 1
data = "data.npz"
rate_hz = {RATE_HZ}
[twin]
kind = "state_space"
[twin.parameters]
A = [[-0.77]]
B = [[0.092]]
C = [[1.0]]
D = [[0.0]]
hold = "zero"
"""
        + channel("u", "input", "feed", "V")
        + channel("y", "output", "flow", "V")
    )
    posed = pose(load(tmp_path / "recording.toml"), 0.3, 0, None, lambda *_: (set(), []))
    place = next(p for p in places(posed.problem, posed.effects, ()) if p.effect.name == "dead_time")
    found = added(posed.problem, posed.base, place)
    assert found.theta[-1] == pytest.approx(DELAY_S, abs=0.05)
