"""(g) Equations of one's own as a twin: a free run of a two-mass drive, from text as machine code, against the same
equations written by hand in numba; and its whole diagnosis, of a drive with dry friction."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.row import Row, side_by_side
from hal.arrays import Array
from hal.compiled import kernel

N, RATE_HZ = 6000, 200.0
FRICTION_NM = 0.35
NUMBERS = (0.02, 0.05, 20.0, 0.05, 0.05, 0.05, 1.0)
"""Inertias of motor and load (kg m^2), stiffness (N m/rad) and damping (N m s/rad) of the joint, drag of both
(N m s/rad), stiffness of the load (N m/rad)."""
DESCRIPTOR = """format = 1
data = "data.csv"
rate_hz = 200

[twin]
kind = "ode"
[twin.states]
motor_rad = "rad"
motor_rate = "rad/s"
load_rad = "rad"
load_rate = "rad/s"
[twin.equations]
between = "k * (motor_rad - load_rad) + c * (motor_rate - load_rate)"
motor_rad = "motor_rate"
motor_rate = "(torque - between - b1 * motor_rate) / J1"
load_rad = "load_rate"
load_rate = "(between - b2 * load_rate - ks * load_rad) / J2"
[twin.parameters]
J1 = 0.02
J2 = 0.05
k = 20.0
c = 0.05
b1 = 0.05
b2 = 0.05
ks = 1.0
fixed = ["J1"]
outputs = { motor = "1e3 * motor_rad", load = "1e3 * load_rad" }
"""
CHANNEL = '\n[[channels]]\ncolumn = "{0}"\nrole = "{1}"\nsignal = "{0}"\nunit = "{2}"\n'


@kernel
def by_hand(x0: Array, torque: Array, numbers: tuple[float, ...], friction: float, step_s: float, sub: int) -> Array:
    """States (n, 4) by fourth-order Runge-Kutta, ``sub`` steps per sample; friction is a steep smooth law."""
    J1, J2, k, c, b1, b2, ks = numbers
    out = np.empty((torque.size, 4))
    x, y, slope = x0.copy(), np.empty(4), np.empty((4, 4))
    h = step_s / sub
    out[0] = x
    for i in range(1, torque.size):
        for m in range(sub):
            for stage in range(4):
                part = 0.0 if stage == 0 else (0.5 if stage < 3 else 1.0)
                for j in range(4):
                    y[j] = x[j] + (part * h * slope[stage - 1, j] if stage > 0 else 0.0)
                u = torque[i - 1] + (m + part) / sub * (torque[i] - torque[i - 1])
                between = k * (y[0] - y[2]) + c * (y[1] - y[3])
                held = friction * np.tanh(y[1] / 1e-3) if friction != 0.0 else 0.0
                slope[stage, 0], slope[stage, 2] = y[1], y[3]
                slope[stage, 1] = (u - between - b1 * y[1] - held) / J1
                slope[stage, 3] = (between - b2 * y[3] - ks * y[2]) / J2
            for j in range(4):
                x[j] += h / 6.0 * (slope[0, j] + 2.0 * slope[1, j] + 2.0 * slope[2, j] + slope[3, j])
        out[i] = x
    return out


def torque_Nm() -> Array:
    """Five sines, which reverse the motor several times a second."""
    t = np.arange(N) / RATE_HZ
    waves = ((0.17, 1.5), (0.41, 1.2), (0.9, 1.0), (1.7, 0.8), (3.1, 0.6))
    return np.sum([a * np.sin(2 * np.pi * f * t + f) for f, a in waves], axis=0)


def write_recording(folder: Path) -> Path:
    """Write a recording of the drive with friction, whose twin lacks it; return its descriptor."""
    torque = torque_Nm()
    x = by_hand(np.zeros(4), torque, NUMBERS, FRICTION_NM, 1.0 / RATE_HZ, 400)
    noise = 2.0 * np.random.default_rng(3).standard_normal((N, 2))
    table = np.column_stack([torque, 1e3 * x[:, [0, 2]] + noise])
    np.savetxt(folder / "data.csv", table, "%.6g", ",", header="torque,motor,load", comments="")
    columns = (("torque", "input", "N m"), ("motor", "output", "mrad"), ("load", "output", "mrad"))
    text = DESCRIPTOR + "".join(CHANNEL.format(*c) for c in columns)
    (folder / "recording.toml").write_text(text)
    return folder / "recording.toml"


def rows() -> Iterator[Row]:
    from tools.mismatch.infer import diagnose
    from tools.mismatch.recording_load import load
    from tools.mismatch.twins.equations import NOTHING
    from tools.mismatch.twins.make import make
    from tools.mismatch.twins.ode import OdeTwin
    from tools.mismatch.twins.ode_run import Drive

    with tempfile.TemporaryDirectory() as folder:
        recording = load(write_recording(Path(folder)))
    twin = make(recording)
    assert isinstance(twin, OdeTwin)
    torque, first = torque_Nm(), np.array([0])
    drive = Drive(torque[:, None], np.array([False]), recording.t, recording.dt, 1, 1, first, first + N)
    limits = (np.full(4, -np.inf), np.full(4, np.inf))

    def ours() -> Array:
        return twin.equations.states(np.zeros((1, 4)), drive, twin.start_values, NOTHING, limits)

    def peer() -> Array:
        return by_hand(np.zeros(4), torque, NUMBERS, 0.0, recording.dt, 1)

    assert np.allclose(ours(), peer(), rtol=0.0, atol=1e-9)
    mine_us, other_us = side_by_side((ours, peer))
    yield Row(
        "equations, a run", f"{N} samples of four states, CPU; the loop also has room for friction and flows",
        mine_us, other_us, "by hand in numba", "us", mine_us / other_us,
    )  # fmt: skip
    cpu_s = time.process_time()
    names = [p.name for p in diagnose(recording, jobs=1).physics]
    cpu_s = time.process_time() - cpu_s
    yield Row(
        "equations, a diagnosis", f"the drive with dry friction, two outputs, CPU of one process; found {names}",
        cpu_s, 1e-6 * mine_us, "a run", "s", 1e6 * cpu_s / mine_us,
    )  # fmt: skip
