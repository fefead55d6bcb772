"""A curve of one's own: equations without a state, whose outputs follow the inputs at once."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

from sim_devices.physics.catalogue import EFFECTS
from tests.recording_text import channel
from tools.errors import RecordingError
from tools.mismatch.apply import corrected_twin
from tools.mismatch.export.run import simulate_file, simulate_own
from tools.mismatch.export.write import write_twin
from tools.mismatch.infer import diagnose
from tools.mismatch.placed import Placed
from tools.mismatch.recording_load import load
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_view import View, view_run
from tools.mismatch.twins.make import make
from tools.numbers import rms

RATE_HZ = 100.0


def described(twin: str, *channels: str) -> str:
    """Return a descriptor of a curve, ``[twin.outputs]`` and what follows."""
    head = 'format = 1\ndata = "data.csv"\nrate_hz = 100.0\n[twin]\nkind = "ode"\nhold = "linear"\n'
    return head + twin + "".join(channels)


CURVE = described(
    '[twin.outputs]\nflow = "a * sqrt(max(pressure, 0) + b)"\n[twin.parameters]\na = 1.8\nb = 0.1\n',
    channel("pressure", "input", "pressure", "kPa"),
    channel("flow", "output", "flow", "l/min"),
)


def recorded(folder: Path, lag_s: float, text: str = CURVE) -> Path:
    t = np.arange(1500) / RATE_HZ
    p = 2.5 + 2.2 * np.sin(2 * np.pi * 0.31 * t) * np.cos(2 * np.pi * 0.05 * t) + 0.2 * np.sin(2 * np.pi * 1.7 * t)
    now = 1.9 * np.sqrt(np.maximum(p, 0.0) + 0.1)
    flow = now.copy()
    for k in range(1, t.size if lag_s else 0):
        flow[k] = flow[k - 1] + (now[k] - flow[k - 1]) * (1.0 - np.exp(-1.0 / RATE_HZ / lag_s))
    flow += 0.01 * np.random.default_rng(5).standard_normal(t.size)
    np.savetxt(folder / "data.csv", np.c_[p, flow], delimiter=",", header="pressure,flow", comments="")
    (folder / "recording.toml").write_text(text)
    return folder


def test_a_curve_follows_its_input_at_once(tmp_path: Path) -> None:
    recording = load(recorded(tmp_path, 0.0))
    p = recording.inputs["pressure"]
    assert simulate_own(recording)["flow"] == pytest.approx(1.8 * np.sqrt(np.maximum(p, 0.0) + 0.1), abs=1e-9)


def test_what_is_missing_behind_a_curve_is_named_and_the_corrected_curve_runs_elsewhere(tmp_path: Path) -> None:
    path = recorded(tmp_path, 0.15)
    recording = load(path)
    report = diagnose(recording, jobs=1, effects=[EFFECTS["first_order_lag"], EFFECTS["creep"]])
    assert [p.name for p in report.physics] == ["first_order_lag"]
    # the generator holds its input over a sample, where the twin's runs straight: half a sample more
    assert report.physics[0].parameters["time_constant_s"].value == pytest.approx(0.15 - 0.5 / RATE_HZ, abs=3e-3)
    twin = corrected_twin(path, report.to_json())
    write_twin(twin, report.to_json(), tmp_path / "twin.py")
    write_twin(twin, report.to_json(), tmp_path / "twin.toml")
    flow = runpy.run_path(str(tmp_path / "twin.py"))["simulate"]({"pressure": recording.inputs["pressure"]})["flow"]
    assert flow == pytest.approx(simulate_file(tmp_path / "twin.toml", path)["flow"], abs=1e-3)
    assert rms(flow - recording.outputs["flow"]) < 1.1 * 0.01


DAMPER = described(
    '[twin.outputs]\nforce = "k * displacement + c * velocity"\n[twin.parameters]\nk = 300.0\nc = 50.0\n',
    channel("displacement", "input", "displacement", "mm"),
    channel("velocity", "input", "velocity", "mm/s"),
    channel("force", "output", "force", "N"),
)


def damper(folder: Path) -> Path:
    """Write a recording of a spring and a dashpot with dry friction behind a spring (Masing's element) beside them."""
    t = np.arange(3000) / RATE_HZ
    x = (1 + 0.6 * np.sin(0.1 * np.pi * t)) * np.sin(np.pi * t) + 0.3 * np.sin(0.34 * np.pi * t)
    v, z = np.gradient(x, 1.0 / RATE_HZ), np.zeros(t.size)
    for k in range(1, t.size):
        z[k] = np.clip(z[k - 1] + x[k] - x[k - 1], -0.3, 0.3)
    force = 200.0 * x + 30.0 * v + 900.0 * z + 5.0 * np.random.default_rng(7).standard_normal(t.size)
    np.savetxt(
        folder / "data.csv", np.c_[x, v, force], delimiter=",", header="displacement,velocity,force", comments=""
    )
    (folder / "recording.toml").write_text(DAMPER)
    return folder


def test_memory_of_an_input_that_an_output_follows_at_once_is_named(tmp_path: Path) -> None:
    """The element is stiffer before it slips, which is no play."""
    path = damper(tmp_path)
    names = ("hysteresis", "backlash", "static_nonlinearity", "first_order_lag")
    report = diagnose(load(path), jobs=1, effects=[EFFECTS[n] for n in names])
    (found,) = report.physics
    assert (found.name, found.site, found.target) == ("hysteresis", "input", "displacement")
    assert report.fit.fitted_rms["force"] < 1.3 * 5.0
    for name in ("twin.py", "twin.toml"):
        write_twin(corrected_twin(path, report.to_json()), report.to_json(), tmp_path / name)
        left = simulate_file(tmp_path / name, path)["force"] - load(path).outputs["force"]
        assert rms(left) < 1.3 * 5.0


def test_what_passes_at_once_is_seen_at_the_output(tmp_path: Path) -> None:
    recording = load(damper(tmp_path))
    twin = make(recording)
    theta = twin.start(recording)
    change = np.random.default_rng(1).standard_normal(recording.n)
    carried = twin.through(view_run(twin, View.whole(recording)), "velocity", theta, "force")(change)
    np.testing.assert_allclose(carried, 50.0 * change, rtol=1e-6)


def test_weights_at_an_input_of_a_sum_stay_linear(tmp_path: Path) -> None:
    recording = load(damper(tmp_path))
    twin = make(recording)
    view = View.whole(recording)
    settings = {"range": (-2.0, 2.0), "rest": (0.0,)}
    loop = Placed(EFFECTS["hysteresis"], "input", "displacement", "actuator", ("force",), settings)
    model = Model(twin, [loop])
    theta = np.concatenate([twin.start(recording), np.linspace(0.1, 1.0, len(loop.parts.weights))])
    assert len(model.linear) == len(loop.parts.weights)
    design = model.design(view, theta)
    sums = design.constant["force"] + design.columns["force"] @ theta[list(design.linear["force"])]
    np.testing.assert_allclose(sums, model.simulate(view, theta)["force"], rtol=1e-9)


def test_states_without_equations_are_refused(tmp_path: Path) -> None:
    text = CURVE.replace("[twin.outputs]", '[twin.states]\nv = "m/s"\n[twin.outputs]')
    with pytest.raises(RecordingError, match="equations"):
        simulate_own(load(recorded(tmp_path, 0.0, text)))
