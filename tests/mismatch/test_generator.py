"""The blind prover's generator: deterministic, severities as stated, nothing of the answer in the recordings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.signal import lsim

from tools.mismatch.recording_load import load
from tools.mismatch.units import convert_difference
from tools.research.prove import draw, guests, kernels, noise
from tools.research.prove.catalog import TABLE, TWINS
from tools.research.prove.disk import contract_unit, write
from tools.research.prove.plans import plans as drawn_plans
from tools.research.prove.plants import Scene, simulate
from tools.research.prove.proof import generate


def _case(twin: str, effects: tuple[str, ...], severity: float, seed: int = 3, kind: str = "single") -> draw.Case:
    return draw.make([seed], draw.Plan(kind, twin, effects, severity), max_samples=1500)


@pytest.mark.parametrize(
    ("twin", "effect"),
    [("piezo_stack", "hysteresis"), ("accelerometer", "misalignment"), ("magnetometer", "thermal_drift")],
)
def test_severity_is_what_a_straight_line_leaves_of_the_file(tmp_path: Path, twin: str, effect: str) -> None:
    """From the file alone: residual of a least-squares line against the noise gives back the severity."""
    severity = 10.0
    case = _case(twin, (effect,), severity)
    rec = load(write(case, tmp_path, "recording", np.random.default_rng(1)))
    worst = 0.0
    for name, y in rec.outputs.items():
        u = (
            next(iter(rec.inputs.values()))
            if twin == "piezo_stack"
            else next(v for k, v in rec.inputs.items() if k[-1] == name[-1])
        )
        line = np.stack([u, np.ones_like(u)], axis=1)
        left = y - line @ np.linalg.lstsq(line, y, rcond=None)[0]
        worst = max(worst, float(np.std(left)) / case.noise_rms[name])
    assert np.sqrt(max(worst**2 - 1.0, 0.0)) == pytest.approx(severity, rel=0.06)


def test_severity_on_an_axis_against_an_independent_fit() -> None:
    """The same with scipy's simulator and optimiser on a mechanical axis with friction."""
    case = _case("mechanical_axis", ("coulomb_friction",), 10.0, seed=8)
    s = case.scene
    t, f, out = s.t[: s.keep], s.inputs["force"][: s.keep], s.outputs[0]
    y = case.recorded[out]
    p0 = s.parameters

    def model(p: np.ndarray) -> np.ndarray:
        m, c, k, off, x0, v0 = p
        row = [[1.0, 0.0]] if out == "position" else [[0.0, 1.0]]
        system = ([[0.0, 1.0], [-k / m, -c / m]], [[0.0], [1.0 / m]], row, [[0.0]])
        return lsim(system, f + off, t, [x0, v0])[1]

    start = np.array([p0["mass"], p0["damping"], p0["stiffness"], p0["offset_force"], *s.hidden.values()])
    unit = np.maximum(np.abs(start), [1, 1, 1, 0.1 * np.max(np.abs(f)), np.max(np.abs(y)), np.max(np.abs(y))])
    sigma = case.noise_rms[out]
    done = least_squares(lambda q: (model(q * unit) - y) / sigma, start / unit, max_nfev=8)
    assert np.sqrt(np.mean(done.fun**2) - 1.0) == pytest.approx(case.truths[0].rms_after_refit, rel=0.1)


def test_same_seed_same_bytes_and_another_seed_another_recording(tmp_path: Path) -> None:
    plans = [draw.Plan("single", "piezo_stack", ("creep",), 4.0), draw.Plan("agrees", "state_space", (), 4.0)]
    first, a1 = generate(11, plans, tmp_path / "a", max_samples=3000)
    again, a2 = generate(11, plans, tmp_path / "b", max_samples=3000)
    other, a3 = generate(12, plans, tmp_path / "c", max_samples=3000)
    assert a1 == a2 != a3
    for name in first:
        mine = {p.name: p.read_bytes() for p in first[name].parent.iterdir()}
        assert mine == {p.name: p.read_bytes() for p in again[name].parent.iterdir()}
        assert first[name].read_bytes() != other[name].read_bytes()


def test_recordings_hold_no_answer_and_load_as_the_contract_says(tmp_path: Path) -> None:
    names = sorted({n for t in TABLE.values() for n in t} | {"unknown", "severity", "agrees", "recalibrate"})
    plans = drawn_plans(5, 10)
    plans += [draw.Plan("agrees", t, (), 4.0) for t in TWINS] + [draw.Plan("unknown", "piezo_stack", (), 10.0)]
    paths, answers = generate(5, plans, tmp_path, max_samples=3000)
    assert len(answers) >= len(plans) - 2
    for name, path in paths.items():
        with guests.installed(path):
            rec = load(path)
        assert rec.twin.kind == answers[name]["twin"]
        assert set(rec.outputs) == set(answers[name]["noise_rms"])
        assert rec.n == answers[name]["samples"]
        text = path.read_text()
        csv = path.parent / "data.csv"
        if csv.exists():
            text += csv.read_text().splitlines()[0]
        beside = {guests.FMU: {"model.fmu"}, guests.INSTRUMENT: {"bench.toml"}}.get(rec.twin.kind, set())
        assert {p.name for p in path.parent.iterdir()} - beside in (
            {"data.csv", "recording.toml"},
            {"data.npz", "recording.toml"},
        )
        assert not [n for n in names if n in text]
        for out, rms in answers[name]["noise_rms"].items():
            declared = rec.noise[out]
            assert (declared is not None) == answers[name]["noise_declared"]
            if rec.twin.kind == guests.INSTRUMENT:  # speaks in the recording's units
                rms = convert_difference(rms, contract_unit(out), rec.unit[out])
            assert declared is None or declared == pytest.approx(rms, rel=1e-6)


@pytest.mark.parametrize("kind", noise.KINDS)
def test_noise_has_the_stated_rms(kind: str) -> None:
    rng = np.random.default_rng(2)
    x = noise.draw(rng, kind, 200_000, 0.3)
    assert np.std(x) == pytest.approx(0.3, rel=0.06)


def test_every_class_of_the_table_can_be_drawn_somewhere() -> None:
    """One class per twin, a different one each time the module is run with another table: cheap and broad."""
    for twin in TWINS:
        name = sorted(TABLE[twin])[len(TABLE[twin]) // 2]
        case = _case(twin, (name,), 10.0)
        assert case.truths[0].name == name
        assert case.truths[0].rms_after_refit == pytest.approx(10.0, rel=0.25)
        assert all(np.all(np.isfinite(v)) for v in case.recorded.values())


def test_agreeing_recording_is_the_given_twin_plus_its_noise(tmp_path: Path) -> None:
    case = _case("state_space", (), 4.0, kind="agrees")
    clean = simulate(case.scene)
    for k, v in case.recorded.items():
        assert np.std(v - clean[k]) == pytest.approx(case.noise_rms[k], rel=0.15)


def test_axis_without_effects_is_the_linear_axis() -> None:
    t = np.arange(2000) / 1000.0
    force = 3.0 * np.sin(2 * np.pi * 3 * t)
    p = np.zeros(20)
    p[:3] = 0.5, 2.0, 80.0
    p[6] = p[10] = p[11] = p[12] = p[17] = 1.0
    x, _ = kernels.axis(force, 1e-3, p, 0.01, 0.0)
    _, y, _ = lsim(([[0, 1], [-160.0, -4.0]], [[0], [2.0]], [[1, 0]], [[0]]), force, t, [0.01, 0.0])
    assert np.max(np.abs(x - y)) < 1e-8


def test_friction_brings_a_free_mass_to_rest_where_energy_says() -> None:
    """m v0^2 / 2 = F d, and then it stays."""
    for kind in (2.0, 3.0, 4.0):
        p = np.zeros(20)
        p[0], p[6], p[17] = 2.0, 1.0, 1.0
        p[9], p[10], p[11], p[12], p[13] = kind, 5.0, 5.0, 0.01, 5.0 / 1e-4
        x, v = kernels.axis(np.zeros(8_000), 2.5e-4, p, 0.0, 1.0)
        assert x[-1] == pytest.approx(2.0 / (2 * 5.0), rel=0.01)
        assert abs(np.mean(v[-2000:])) < 1e-3


def test_memory_kernels_do_not_know_time_and_free_play_stands_still() -> None:
    t = np.linspace(0, 1, 4001)
    x = np.sin(2 * np.pi * 2 * t) * (0.4 + 0.6 * t)
    slow = np.interp(np.linspace(0, 1, 16001), t, x)
    z = kernels.bouc_wen(x, 1.0, 2.0, 0.7, 0.7, 1.0)
    assert np.max(np.abs(kernels.bouc_wen(slow, 1.0, 2.0, 0.7, 0.7, 1.0)[::4] - z)) < 5e-3
    fast = kernels.bouc_wen_rate(x, 1e-4, 1.0, 2.0, 0.7, 0.5, 1.0, 0.0)
    calm = kernels.bouc_wen_rate(x, 1e-2, 1.0, 2.0, 0.7, 0.5, 1.0, 0.0)
    assert np.max(np.abs(fast - calm)) > 0.05
    y = kernels.free_play(np.array([0.0, 1.0, 0.7, 0.5, 0.3, -1.0]), 0.3, 0.0)
    assert y.tolist() == pytest.approx([0.0, 0.7, 0.7, 0.7, 0.6, -0.7])


def test_kernels_agree_with_their_python_twins() -> None:
    rng = np.random.default_rng(4)
    x = np.cumsum(rng.normal(size=200)) * 0.05
    up, w = np.array([0.1, 0.3, 0.5]), np.array([1.0, 0.5, 0.25])
    args = [
        (kernels.bouc_wen, (x, 1.0, 2.0, 0.7, 0.3, 1.5)),
        (kernels.bouc_wen_rate, (x, 0.01, 1.0, 2.0, 0.7, 0.5, 1.0, 0.3)),
        (kernels.relays, (x, up, up - 0.2, w)),
        (kernels.slip_elements, (x, w, up)),
        (kernels.jiles, (x, 0.4, 0.3, 0.1, 0.05)),
        (kernels.hodgdon, (x, 2.0, 0.8, 0.3)),
        (kernels.free_play, (x, 0.1, 0.05)),
        (kernels.limited_rate, (x, 0.01, 0.0)),
    ]
    for fn, a in args:
        assert np.allclose(fn(*a), fn.py_func(*a), atol=1e-12)


def test_hold_and_ramp_between_samples() -> None:
    t = np.arange(50) / 100.0
    u = np.random.default_rng(0).normal(size=50)
    p = {"A": [[-5.0]], "B": [[5.0]], "C": [[1.0]], "D": [[0.0]], "x0": [0.0]}
    for hold, interp in (("linear", True), ("zero", False)):
        s = Scene("state_space", t, 4, {"drive": u}, {}, ("y",), p, {}, "test", 50, hold)
        y = simulate(s)["y"]
        ref = lsim(([[-5.0]], [[5.0]], [[1.0]], [[0.0]]), u, t, interp=interp)[1]
        assert np.max(np.abs(y - ref)) < 1e-9
