"""A run that starts anew in each stretch reads its start states off outputs, which a slow sensor shows late."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tools.mismatch.engine.pose import pose
from tools.mismatch.engine.residual import residuals
from tools.mismatch.engine.screen import places
from tools.mismatch.recording_load import load
from tools.mismatch.simulate import Model

RATE_HZ, NOISE = 100.0, 0.02
DAMPING, LAG_S, FINE = 0.45, 0.06, 20


def shaft(folder: Path) -> Path:
    """Write a recording of a shaft that turns against viscous drag, read by a sensor with a lag."""
    rng, n = np.random.default_rng(4), 3000
    u = np.repeat(rng.uniform(-4.0, 4.0, n // 50), 50)
    v = read = 0.0
    y = np.empty(n)
    for k in range(n):
        y[k] = read
        for _ in range(FINE):
            h = 1.0 / RATE_HZ / FINE
            read += h * (v - read) / LAG_S
            v += h * (u[k] - DAMPING * v)
    np.savez(folder / "data.npz", u=u, y=y + rng.normal(0.0, NOISE, n))
    (folder / "recording.toml").write_text(f"""format = 1
data = "data.npz"
rate_hz = {RATE_HZ}
[twin]
kind = "mechanical_axis"
[twin.parameters]
mass = 1.0
damping = {DAMPING}
hold = "zero"
[[channels]]
column = "u"
role = "input"
signal = "force"
unit = "N"
[[channels]]
column = "y"
role = "output"
signal = "velocity"
unit = "m/s"
""")
    return folder / "recording.toml"


def test_a_slow_sensor_does_not_move_the_start_states(tmp_path: Path) -> None:
    posed = pose(load(shaft(tmp_path)), 0.3, 0, None, lambda *_: (set(), []))
    problem = posed.problem
    assert problem.twin.restart
    (lag,) = (
        p for p in places(problem, posed.effects, ()) if p.effect.name == "first_order_lag" and p.site == "output"
    )
    model = Model(problem.twin, [lag])
    theta = model.start(posed.recording)
    theta[-1] = LAG_S
    r = residuals(problem, model, theta)["velocity"][problem.fit_rows]
    assert np.sqrt(np.mean(r**2)) < 1.1 * NOISE
