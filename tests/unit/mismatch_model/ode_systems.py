"""A motor and a pendulum as twins of equations, and their recordings, for the tests of such twins."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

from tests.recording_text import channel
from tools.mismatch.recording import Recording
from tools.mismatch.recording_load import load

RATE_HZ = 100.0


CHANNELS = channel("u", "input", "command", "V") + channel("y", "output", "angle", "rad")


MOTOR = """
[twin]
kind = "ode"

[twin.states]
angle = "rad"
speed = { unit = "rad/s", start = 0.0 }

[twin.equations]
angle = "speed"
speed = "(gain * command - speed) / tau"

[twin.parameters]
gain = 20.0
tau  = 0.08
"""


PENDULUM = """
[twin]
kind = "ode"
[twin.states]
angle = "rad"
speed = "rad/s"
[twin.equations]
angle = "speed"
speed = "(20.0 * command - speed) / tau"
[twin.parameters]
tau = 0.09
"""


def recorded(folder: Path, twin: str, u: np.ndarray, y: np.ndarray, channels: str = CHANNELS) -> Recording:
    """A recording of ``u`` and ``y`` (n,) with that twin, loaded."""
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(folder / "data.npz", u=u, y=y)
    head = f'format = 1\ndata = "data.npz"\nrate_hz = {RATE_HZ}\n'
    (folder / "recording.toml").write_text(head + twin + channels)
    return load(folder)


def command(n: int = 600) -> np.ndarray:
    t = np.arange(n) / RATE_HZ
    return np.sin(2 * np.pi * 0.4 * t) + 0.5 * np.sin(2 * np.pi * 1.7 * t + 1.0)


def pendulum(folder: Path) -> tuple[Recording, np.ndarray]:
    """A motor that lifts a weight on a lever over the top, integrated by SciPy; its twin has no weight."""
    u = 1.1 * command(900)
    t = np.arange(u.size) / RATE_HZ
    exact = solve_ivp(
        lambda now, x: [x[1], (20 * np.interp(now, t, u) - x[1]) / 0.09 - 160.0 * math.sin(x[0] - 0.3)],
        (0, t[-1]), [0.0, 0.0], t_eval=t, rtol=1e-10, atol=1e-10, max_step=0.5 / RATE_HZ,
    ).y[0]  # fmt: skip
    return recorded(folder, PENDULUM, u, exact), exact
