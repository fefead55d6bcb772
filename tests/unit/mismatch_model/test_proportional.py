"""Damping, a spring and a loss that a twin of equations lacks: the twin with the effect is the twin with the term."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_model.ode_systems import CHANNELS, command, recorded
from tools.mismatch.apply import corrected_twin
from tools.mismatch.export.run import simulate_file
from tools.mismatch.export.write import write_twin
from tools.mismatch.infer import diagnose
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_sites import sites
from tools.mismatch.simulate_view import View
from tools.mismatch.twins.make import make

BODY = """
[twin]
kind = "ode"
[twin.states]
angle = "rad"
speed = "rad/s"
[twin.equations]
angle = "speed"
speed = "(command{lacking}) / inertia"
[twin.parameters]
inertia = 0.5
c = 1.5
k = 40.0
load = 0.8
fixed = ["c", "k", "load", "inertia", "angle_offset"]
hold = "zero"
"""
TANK = """
[twin]
kind = "ode"
[twin.states]
angle = {{ unit = "m", start = 0.2 }}
[twin.equations]
angle = "0.3 * command{lacking}"
[twin.parameters]
loss = 1.4
rest = 0.1
fixed = ["loss", "rest", "angle_offset"]
hold = "zero"
"""


@pytest.mark.parametrize(
    ("twin", "name", "beside", "term", "weights"),
    [
        (BODY, "viscous_friction", " - k * angle", " - c * speed", (3.0,)),
        (BODY, "linear_stiffness", " - c * speed", " - k * angle + load", (80.0, 1.6)),
        (TANK, "linear_loss", "", " - loss * (angle - rest)", (1.4, 0.14)),
    ],
)
def test_a_term_as_an_effect_is_the_term_in_the_equations(
    twin: str, name: str, beside: str, term: str, weights: tuple[float, ...], tmp_path: Path
) -> None:
    u = 3.0 * command(600)
    channels = CHANNELS if twin == BODY else CHANNELS.replace('"rad"', '"m"')
    whole = recorded(tmp_path / "whole", twin.format(lacking=beside + term), u, 0.1 * u, channels)
    full = Model(make(whole))
    true = full.simulate(View.whole(whole), full.start(whole))["angle"]
    recording = recorded(tmp_path / "lacking", twin.format(lacking=beside), u, true, channels)
    base = make(recording)
    (place,) = sites(base, recording, EFFECTS[name])
    if len(weights) == 2 and twin == BODY:
        assert base.facts("angle")  # nothing holds the position
        place = replace(place, settings=dict(base.facts("angle")))
    model = Model(base, [place])
    theta = model.start(recording)
    theta[model.slices(0)[1]] = weights
    residual = model.residual(View.whole(recording), theta)["angle"]
    assert np.std(true) > 0.01
    assert np.max(np.abs(residual)) < 1e-5 * np.std(true)


def test_a_velocity_alone_has_no_spring(tmp_path: Path) -> None:
    fan = """
[twin]
kind = "ode"
[twin.states]
angle = "rad/s"
[twin.equations]
angle = "(command - b * angle) / inertia"
[twin.parameters]
b = 0.1
inertia = 0.5
"""
    recording = recorded(tmp_path, fan, command(), 0.1 * command(), CHANNELS.replace('"rad"', '"rad/s"'))
    twin = make(recording)
    for name in ("linear_stiffness", "cubic_stiffness", "cogging", "clearance", "amplitude_dependent_damping"):
        assert not [p for p in sites(twin, recording, EFFECTS[name]) if p.site == "feedback"], name
    assert [p.target for p in sites(twin, recording, EFFECTS["viscous_friction"])] == ["angle"]


OSCILLATOR = """
[twin]
kind = "ode"
[twin.states]
angle = "rad"
speed = "rad/s"
[twin.equations]
angle = "speed"
speed = "(command - k * angle) / inertia"
[twin.parameters]
inertia = 2.05
k = 145.0
hold = "zero"
"""


@pytest.mark.slow
def test_forgotten_damping_of_a_mode_that_rings_is_named_alone(tmp_path: Path) -> None:
    """Over 15 s the phase of the mode turns by 130 rad: a sensitivity over three per cent of its stiffness is none."""
    n, dt, parts = 1500, 0.01, 20
    rng = np.random.default_rng(8)
    u = np.repeat(rng.uniform(-5.0, 5.0, n // 20), 20)
    transition = _exactly(np.array([[0.0, 1.0], [-75.0, -1.5]]), dt / parts)
    x, y = np.zeros(2), np.empty(n)
    for i in range(n):
        y[i] = x[0]
        for _ in range(parts):
            rest = np.array([u[i] / 150.0, 0.0])
            x = rest + transition @ (x - rest)
    recording = recorded(tmp_path, OSCILLATOR, u, y + 5e-4 * rng.standard_normal(n))
    report = diagnose(recording, jobs=1)
    assert [p.name for p in report.physics] == ["viscous_friction"]
    (found,) = report.physics[0].parameters.values()
    assert found.value == pytest.approx(3.0, rel=0.03)
    assert found.ci95[0] < 3.0 < found.ci95[1]
    assert report.fit.fitted_rms["angle"] < 1.1 * 5e-4
    body = report.to_json()
    for ending in ("toml", "py"):
        write_twin(corrected_twin(tmp_path, body), body, tmp_path / f"twin.{ending}")
    runs = [simulate_file(tmp_path / f"twin.{ending}", tmp_path)["angle"] for ending in ("toml", "py")]
    assert np.std(runs[0] - y) < 5e-4
    assert np.max(np.abs(runs[0] - runs[1])) < 1e-9


def _exactly(a: np.ndarray, step_s: float) -> np.ndarray:
    """The transition of x' = a x, for distinct eigenvalues."""
    values, vectors = np.linalg.eig(a)
    return np.real(vectors @ np.diag(np.exp(values * step_s)) @ np.linalg.inv(vectors))
