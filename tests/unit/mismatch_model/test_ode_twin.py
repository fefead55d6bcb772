"""Twins of differential equations: equations as data, free runs, forces and flows inside, start states, bad input."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hal.trust import trust_program
from sim_devices.physics.catalogue import EFFECTS
from tools.errors import RecordingError
from tools.guest.equations import Builder, EquationError, trace
from tools.mismatch.engine.reach import not_tried
from tools.mismatch.recording import Recording
from tools.mismatch.recording_load import load
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_flows import flow_starts
from tools.mismatch.simulate_sites import sites
from tools.mismatch.simulate_start import prepare
from tools.mismatch.simulate_view import View
from tools.mismatch.twins.make import make
from tools.mismatch.twins.program import parse, run_program

RATE_HZ = 100.0

CHANNELS = """
[[channels]]
column = "u"
role   = "input"
signal = "command"
unit   = "V"

[[channels]]
column = "y"
role   = "output"
signal = "angle"
unit   = "rad"
"""

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


def value_of(text: str, **values: float) -> float:
    builder = Builder(tuple(values))
    program = builder.program(parse(builder, {"wanted": text}, ["wanted"]))
    registers = program.registers.copy()
    registers[: len(values)] = [*values.values()]
    run_program(program.operations, registers)
    return float(registers[program.results[0]])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a + 2*b - a/b", lambda a, b: a + 2 * b - a / b),
        ("-a**2 + abs(b)**0.5", lambda a, b: -(a**2) + abs(b) ** 0.5),
        ("sqrt(max(b, 0)) if a < b else exp(-a)", lambda a, b: math.sqrt(max(b, 0)) if a < b else math.exp(-a)),
        ("where(a >= b, tanh(a), sign(b) * pi)", lambda a, b: math.tanh(a) if a >= b else math.pi),
        ("clip(a, -0.5, 0.5) + atan2(a, b)", lambda a, b: min(max(a, -0.5), 0.5) + math.atan2(a, b)),
        ("min(a, b) * sin(a) - max(a, b) * cos(b)", lambda a, b: min(a, b) * math.sin(a) - max(a, b) * math.cos(b)),
    ],
)
@pytest.mark.parametrize(("a", "b"), [(0.3, 1.7), (2.5, 1.1)])
def test_an_equation_says_what_python_would(text: str, expected, a: float, b: float) -> None:
    assert value_of(text, a=a, b=b) == pytest.approx(expected(a, b), rel=1e-14)


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os').system('true')", "a.real", "[a][0]", "(lambda: a)()", "open('x')", "a if", "c + 1", "1e999",
        "sqrt(a, a)", "a @ a", "f'{a}'", "a and a", "a == 1", "a[0]", "'text'", "wanted + 1",
    ],
)  # fmt: skip
def test_nothing_but_arithmetic_is_an_equation(text: str) -> None:
    with pytest.raises(EquationError, match=r"wanted|finite"):
        value_of(text, a=1.0)


def test_an_equation_that_never_ends_is_refused() -> None:
    with pytest.raises(EquationError, match=r"nested too deeply|cannot be read"):
        value_of("(" * 3000 + "a" + ")" * 3000, a=1.0)


def test_a_python_function_becomes_the_same_equations() -> None:
    def derivatives(t, states, inputs, parameters):
        drag = np.where(states["v"] > 0, parameters["c"] * states["v"] ** 2, -np.abs(states["v"]))
        return {"x": states["v"], "v": (inputs["u"] - np.clip(drag, -5, 5)) / 2 + np.sqrt(np.square(t))}

    names = ("t", "x", "v", "u", "c")
    builder = Builder(names)
    found = trace(builder, derivatives, {"states": ("x", "v"), "inputs": ("u",), "parameters": ("c",)})
    program = builder.program([found["x"], found["v"]])
    for values in ((1.0, 0.5, 1.5, 2.0, 0.3), (2.0, 0.5, -1.5, 2.0, 0.3)):
        registers = program.registers.copy()
        registers[: len(names)] = values
        run_program(program.operations, registers)
        t, x, v, u, c = values
        expected = derivatives(t, {"x": x, "v": v}, {"u": u}, {"c": c})
        assert [registers[i] for i in program.results] == pytest.approx([expected["x"], expected["v"]], rel=1e-14)


def test_a_function_that_branches_on_a_state_says_how_to_write_it() -> None:
    def derivatives(t, states, inputs, parameters):
        return {"x": 1.0 if states["x"] > 0 else 2.0}

    groups = {"states": ("x",), "inputs": (), "parameters": ()}
    with pytest.raises(EquationError, match=r"numpy\.where"):
        trace(Builder(("t", "x")), derivatives, groups)


@pytest.mark.parametrize(
    ("derivatives", "message"),
    [
        (lambda t, s, u, p: {"x": s["y"]}, r"asks for 'y'.*states: x; inputs: none; parameters: none"),
        (lambda t, s, u, p: {"x": s[0]}, r"asks for 0.*states: x"),
        (lambda t, s, u, p: {"x": math.tanh(s["x"])}, r"in place of math and scipy use numpy's"),
        (lambda t, s: {"x": s["x"]}, r"derivatives\(t, states, inputs, parameters\)"),
        (lambda t, s, u, p: [s["x"]], r"must return \{'x': \.\.\.\}, got list"),
    ],
)
def test_a_function_that_cannot_be_traced_says_what_to_write(derivatives, message: str) -> None:
    with pytest.raises(EquationError, match=message):
        trace(Builder(("t", "x")), derivatives, {"states": ("x",), "inputs": (), "parameters": ()})


def test_a_caret_is_no_power() -> None:
    with pytest.raises(EquationError, match=r"write a power as \*\*"):
        value_of("a^2", a=1.0)


def test_a_free_run_is_the_solution(tmp_path: Path) -> None:
    """A pendulum with drag, against an adaptive solver of high order."""
    twin = """
[twin]
kind = "ode"
[twin.states]
angle = { unit = "rad", start = 0.7 }
rate = { unit = "rad/s", start = -0.2 }
[twin.equations]
torque = "kick * command"
angle = "rate"
rate = "torque - 9.0 * sin(angle) - c * rate * abs(rate)"
[twin.parameters]
kick = 2.0
c = 0.3
"""
    u = command()
    t = np.arange(u.size) / RATE_HZ

    def slopes(now: float, x: np.ndarray) -> list[float]:
        return [x[1], 2.0 * np.interp(now, t, u) - 9.0 * np.sin(x[0]) - 0.3 * x[1] * abs(x[1])]

    exact = solve_ivp(slopes, (0, t[-1]), [0.7, -0.2], t_eval=t, rtol=1e-9, atol=1e-9, max_step=0.5 / RATE_HZ).y[0]
    recording = recorded(tmp_path, twin, u, exact)
    model = Model(make(recording))
    residual = model.residual(View.whole(recording), model.start(recording))["angle"]
    assert np.max(np.abs(residual)) < 3e-6


def test_a_start_that_nobody_knows_is_set_by_the_first_samples(tmp_path: Path) -> None:
    u = command()
    t = np.arange(u.size) / RATE_HZ
    exact = solve_ivp(
        lambda now, x: [x[1], (20 * np.interp(now, t, u) - x[1]) / 0.08], (0, t[-1]), [5.0, -12.0],
        t_eval=t, rtol=1e-9, atol=1e-9, max_step=0.5 / RATE_HZ,
    ).y[0]  # fmt: skip
    recording = recorded(tmp_path, MOTOR, u, exact)
    model = Model(make(recording))
    view = View(recording, ((0, 200), (300, 600)), 40)
    assert np.max(np.abs(model.residual(view, model.start(recording))["angle"])) < 1e-3
    assert model.twin.restart


def test_dry_friction_brings_a_body_to_rest_and_keeps_it_there(tmp_path: Path) -> None:
    """Closed form: deceleration mu from v0 stops after v0 / mu, v0^2 / (2 mu) further on."""
    twin = """
[twin]
kind = "ode"
[twin.states]
angle = "rad"
speed = { unit = "rad/s", start = 3.0 }
[twin.equations]
angle = "speed"
speed = "command"
"""
    t = np.arange(400) / RATE_HZ
    mu = 2.0
    y = np.where(t < 1.5, 3 * t - mu * t * t / 2, 2.25)
    push = np.where((t > 2.0) & (t < 3.0), 1.9, 0.0)
    recording = recorded(tmp_path, twin, push, y)
    twin_ = make(recording)
    place = sites(twin_, recording, EFFECTS["coulomb_friction"])[0]
    assert (place.site, place.target) == ("feedback", "speed")
    model = Model(twin_, [place])
    theta = model.start(recording)
    theta[model.slices(0)[1]] = mu, 0.0, 0.0
    residual = model.residual(View.whole(recording), theta)["angle"]
    assert np.max(np.abs(residual)) < 1e-4
    assert np.ptp(model.simulate(View.whole(recording), theta)["angle"][160:]) == 0.0


def test_forces_of_an_axis_and_of_equations_are_the_same(tmp_path: Path) -> None:
    """One declaration of each effect serves both; two integrators meet within their own step errors."""
    u = 3.0 * command(500)
    axis = """
[twin]
kind = "mechanical_axis"
[twin.parameters]
mass = 1.0
damping = 0.4
stiffness = 30.0
"""
    equations = """
[twin]
kind = "ode"
[twin.states]
position = "rad"
velocity = "rad/s"
[twin.equations]
position = "velocity"
velocity = "torque - c * velocity - k * position"
[twin.parameters]
c = 0.4
k = 30.0
"""
    channels = CHANNELS.replace('"command"', '"torque"').replace('"angle"', '"position"').replace('"V"', '"N m"')
    one = recorded(tmp_path / "equations", equations, u, 0.1 * u[::-1], channels)
    for name, weights, searched in (
        ("cubic_stiffness", (400.0, 3.0), ()),
        ("cubic_stiffness", (400.0, 3.0, 60.0), ()),
        ("gravity_load", (-40.0, 9.0), ()),
        ("coulomb_friction", (0.6, 0.1, 0.05), ()),
        ("quadratic_drag", (6.0,), ()),
        ("amplitude_dependent_damping", (300.0,), ()),
        ("clearance", (200.0,), (0.02, 0.01)),
        ("hysteresis", (1.0,), (0.05,)),
    ):
        moved = []
        for recording in (one, None):
            recording = recording or recorded(tmp_path / name, axis, u, moved[0], channels)
            every = sites(make(recording), recording, EFFECTS[name])
            forces = [p for p in every if p.site == "feedback"]
            place = next(p for p in reversed(forces) if len(p.effect.parts({}).weights) == len(weights))
            model = Model(make(recording), [place])
            theta = model.start(recording)
            a, b = model.slices(0)
            theta[a], theta[b] = searched, weights
            moved.append(model.simulate(View.whole(recording), theta)["position"])
        plain = Model(make(one)).simulate(View.whole(one), np.array([0.4, 30.0]))
        assert np.std(moved[0] - plain["position"]) > 0.1 * np.std(moved[0]), name
        assert np.std(moved[0] - moved[1]) < 0.02 * np.std(moved[0]), name


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


def pendulum(folder: Path) -> tuple[Recording, np.ndarray]:
    """A motor that lifts a weight on a lever over the top, integrated by SciPy; its twin has no weight."""
    u = 1.1 * command(900)
    t = np.arange(u.size) / RATE_HZ
    exact = solve_ivp(
        lambda now, x: [x[1], (20 * np.interp(now, t, u) - x[1]) / 0.09 - 160.0 * math.sin(x[0] - 0.3)],
        (0, t[-1]), [0.0, 0.0], t_eval=t, rtol=1e-10, atol=1e-10, max_step=0.5 / RATE_HZ,
    ).y[0]  # fmt: skip
    return recorded(folder, PENDULUM, u, exact), exact


def test_a_weight_on_a_lever_is_a_force_at_an_angle_alone(tmp_path: Path) -> None:
    recording, exact = pendulum(tmp_path / "angle")
    (place,) = sites(make(recording), recording, EFFECTS["gravity_load"])
    place = replace(place, settings={"travel": (float(np.ptp(exact)),)})
    model = Model(make(recording), [place])
    theta = model.start(recording)
    theta[model.slices(0)[1]] = -160.0 * math.cos(0.3), 160.0 * math.sin(0.3)
    assert np.max(np.abs(model.residual(View.whole(recording), theta)["angle"])) < 1e-3
    found = {h.name: h.value for h in model.human(theta)[place.label]}
    assert found["largest_load"] == pytest.approx(160.0 * 0.09 / 20.0)  # in volts of the command
    assert found["angle_at_rest"] == pytest.approx(0.3)
    metres = PENDULUM.replace('"rad"', '"m"').replace('"rad/s"', '"m/s"')
    line = recorded(tmp_path / "line", metres, recording.inputs["command"], exact, CHANNELS.replace('"rad"', '"m"'))
    assert sites(make(line), line, EFFECTS["gravity_load"]) == []


def test_a_stretch_begins_where_it_was_read_and_not_where_a_drifted_run_has_come_to(tmp_path: Path) -> None:
    """Without the weight the twin is turns away by then, and the sine has the wrong phase there."""
    recording, _ = pendulum(tmp_path)
    (place,) = sites(make(recording), recording, EFFECTS["gravity_load"])
    model = Model(make(recording), [place])
    theta = model.start(recording)
    plain = Model(make(recording)).simulate(View.whole(recording), theta[:1])["angle"]
    assert np.max(np.abs(plain - recording.outputs["angle"])) > math.pi
    theta[model.slices(0)[1]] = -160.0 * math.cos(0.3), 160.0 * math.sin(0.3)
    view = View(recording, ((40, 262), (501, 700), (760, 900)), 40, afresh=True)
    assert np.max(np.abs(model.residual(view, theta)["angle"])) < 0.02


def test_flows_of_two_tanks_are_those_of_the_source(tmp_path: Path) -> None:
    """Root outflow of the upper tank into the lower, and overflow, against an adaptive solver."""
    twin = """
[twin]
kind = "ode"
[twin.states]
upper = { unit = "m", start = 0.5, min = 0.0 }
level = { unit = "m", start = 0.4, min = 0.0 }
[twin.equations]
upper = "pump * command - a * upper"
level = "a * upper - b * level"
[twin.parameters]
pump = 1.0
a = 0.1
b = 0.1
"""
    channels = CHANNELS.replace('"angle"', '"level"').replace('"rad"', '"m"')
    u = 1.1 + 0.4 * command()
    t = np.arange(u.size) / RATE_HZ

    def slopes(now: float, h: np.ndarray) -> list[float]:
        top, low = np.sqrt(max(h[0], 0.0)), np.sqrt(max(h[1], 0.0))
        over = max(h[0] - 0.9, 0.0)
        inside = np.interp(now, t, u) - 0.1 * h[0] - 0.8 * top - 3.0 * over
        return [inside, 0.1 * h[0] - 0.1 * h[1] + 0.8 * top - 0.7 * low + 1.2 * over]

    exact = solve_ivp(slopes, (0, t[-1]), [0.5, 0.4], t_eval=t, rtol=1e-9, atol=1e-9, max_step=0.5 / RATE_HZ).y
    assert exact[0].max() > 1.0
    recording = recorded(tmp_path, twin, u, exact[1], channels)
    tanks = make(recording)
    root = next(p for p in sites(tanks, recording, EFFECTS["square_root_outflow"]) if p.target == "upper+level")
    over = next(p for p in sites(tanks, recording, EFFECTS["overflow"]) if p.target == "upper")
    pairs = {p.name: p.pairs for p in tanks.places}  # type: ignore[attr-defined]
    assert pairs["upper+level"] == (0.0, 0.0, 0.0, 1.0, 1.0, 1.0)
    settings = {"range": (0.0, 1.0), "rate": (1.0,)}
    root = replace(root, settings={**settings, "pairs": pairs["upper+level"]})
    over = replace(over, settings={**settings, "pairs": pairs["upper"]})
    model = Model(tanks, [root, over])
    theta = model.start(recording)
    for k, values in enumerate([(0.0, 0.0, 0.8, 0.8, 0.7), (0.9, 3.0, 1.2)]):
        a, b = model.slices(k)
        theta[a.start : b.stop] = values
    residual = model.residual(View.whole(recording), theta)["level"]
    assert np.max(np.abs(residual)) < 2e-5


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('angle = "speed"\n', ""), "no equation for the derivative of state 'angle'"),
        (("gain * command", "gain * comand"), "'comand' is no state, input or parameter"),
        (("tau  = 0.08", 'tau = "fast"'), "tau"),
        (('speed = { unit = "rad/s", start = 0.0 }', 'speed = { unit = "rad/s", begin = 0.0 }'), "states.speed"),
        (('speed = { unit = "rad/s", start = 0.0 }', 'speed = "furlong"'), "states.speed"),
        (("(gain * command - speed) / tau", "1 / (speed - speed)"), "'angle' is nan at sample 1"),
        (("[twin.equations]", "[twin.outputs]\nangle = 'nobody'\n[twin.equations]"), "'nobody'"),
        (('kind = "ode"', 'kind = "ode"\nfunction = "x.py:f"'), "either equations, or function"),
        (("tau  = 0.08", "tau  = 0.08\nspeed = 1.0"), "names two things"),
    ],
)
def test_what_cannot_be_used_is_said(tmp_path: Path, change: tuple[str, str], message: str) -> None:
    text = MOTOR.replace(*change)
    assert text != MOTOR
    u = command()
    with pytest.raises(RecordingError, match=message):
        make(recorded(tmp_path, text, u, 0.1 * u[::-1]))


def test_a_function_beside_the_recording_is_a_twin(tmp_path: Path) -> None:
    text = MOTOR[: MOTOR.index("[twin.equations]")] + MOTOR[MOTOR.index("[twin.parameters]") :]
    text = text.replace('kind = "ode"', 'kind = "ode"\nfunction = "motor.py:derivatives"')
    tmp_path.joinpath("motor.py").write_text(
        "def derivatives(t, states, inputs, parameters):\n"
        "    speed = (parameters['gain'] * inputs['command'] - states['speed']) / parameters['tau']\n"
        "    return {'angle': states['speed'], 'speed': speed}\n"
    )
    trust_program(tmp_path / "motor.py")
    u = command()
    one = recorded(tmp_path, text, u, 0.1 * u[::-1])
    other = recorded(tmp_path / "text", MOTOR, u, 0.1 * u[::-1])
    a, b = (Model(make(r)).simulate(View.whole(r), np.array([20.0, 0.08]))["angle"] for r in (one, other))
    assert np.array_equal(a, b)


def test_matrices_with_named_states_are_the_same_twin_with_an_inside(tmp_path: Path) -> None:
    matrices = """
[twin]
kind = "state_space"
[twin.states]
angle = "rad"
speed = "rad/s"
[twin.parameters]
A = [[0.0, 1.0], [-30.0, -0.4]]
B = [[0.0], [5.0]]
C = [[1.0, 0.0]]
x0 = [0.1, -0.3]
y0 = [0.02]
"""
    u = command()
    plain = recorded(
        tmp_path / "plain", matrices.replace('[twin.states]\nangle = "rad"\nspeed = "rad/s"\n', ""), u, u**2
    )
    named = recorded(tmp_path / "named", matrices, u, u**2)
    one, other = Model(make(plain)), Model(make(named))
    exact = one.simulate(View.whole(plain), one.start(plain))["angle"]
    mine = other.simulate(View.whole(named), other.start(named))["angle"]
    assert np.max(np.abs(mine - exact)) < 1e-5 * np.ptp(exact)
    assert [p.name for p in other.twin.parameters] == ["A_2_1", "A_2_2", "B_2_1", "y0_1"]
    place = sites(other.twin, named, EFFECTS["coulomb_friction"])[0]
    assert (place.site, place.target) == ("feedback", "speed")
    text = other.twin.to_text(other.start(named) * 2.0)
    assert text["A"] == [[0.0, 1.0], [-60.0, -0.8]]
    assert text["states"] == {"angle": "rad", "speed": "rad/s"}


def test_columns_of_simulated_output_are_a_twin_that_says_what_could_not_be_tried(tmp_path: Path) -> None:
    u = command()
    columns = """
[[channels]]
column = "u"
role   = "input"
signal = "simulated_angle"
unit   = "rad"

[[channels]]
column = "y"
role   = "output"
signal = "angle"
unit   = "rad"
"""
    recording = recorded(tmp_path, '[twin]\nkind = "columns"\n', u, 1.02 * u + 0.1, columns)
    twin = make(recording)
    model = Model(twin)
    residual = model.residual(View.whole(recording), model.start(recording))["angle"]
    assert np.allclose(residual, 0.02 * u + 0.1)
    assert "kind 'ode'" in not_tried(twin)
    assert not sites(twin, recording, EFFECTS["coulomb_friction"])
    assert {p.site for p in sites(twin, recording, EFFECTS["backlash"])} == {"output"}
    assert not_tried(make(recorded(tmp_path / "motor", MOTOR, u, u**2))) == ""
    with pytest.raises(RecordingError, match="simulated_angle"):
        make(recorded(tmp_path / "bad", '[twin]\nkind = "columns"\n', u, u**2))


def test_a_parameter_may_follow_a_recorded_signal(tmp_path: Path) -> None:
    """The effect does what the same law written into the equations does."""
    channels = CHANNELS + '\n[[channels]]\ncolumn = "T"\nrole = "context"\nsignal = "temperature"\nunit = "degC"\n'
    u = command()
    warm = 20.0 + 15.0 * np.linspace(0.0, 1.0, u.size) ** 2
    np.savez(tmp_path / "data.npz", u=u, y=0.1 * u[::-1], T=warm)
    head = f'format = 1\ndata = "data.npz"\nrate_hz = {RATE_HZ}\n'
    found: list[np.ndarray] = []
    for law in ("tau", "(tau * (1 + 0.05 * (temperature - 25)))"):
        (tmp_path / "recording.toml").write_text(head + MOTOR.replace("/ tau", f"/ {law}") + channels)
        recording = load(tmp_path)
        twin = make(recording)
        places = [p.target for p in sites(twin, recording, EFFECTS["parameter_variation"])]
        assert places == ["gain by temperature", "tau by temperature"]
        found.append(Model(twin).simulate(View.whole(recording), np.array([20.0, 0.08]))["angle"])
        if law == "tau":
            place = sites(twin, recording, EFFECTS["parameter_variation"])[1]
            pairs = twin.place(place.target).pairs  # type: ignore[attr-defined]
            model = Model(twin, [replace(place, settings={"centre": (25.0,), "spread": (5.0,), "pairs": pairs})])
            found.append(model.simulate(View.whole(recording), np.array([20.0, 0.08, 0.05]))["angle"])
    plain, by_effect, written = found
    assert np.allclose(by_effect, written, rtol=0, atol=1e-12)
    assert np.std(plain - written) > 0.01


def noisy_motor(folder: Path) -> tuple[Recording, np.ndarray]:
    """A recording of the motor with sensor noise of 10 mrad, and the angle without it (600,)."""
    u = command()
    plain = recorded(folder / "plain", MOTOR, u, 2.0 * u)
    twin = make(plain)
    true = Model(twin).simulate(View.whole(plain), twin.start(plain))["angle"]
    noise = 0.01 * np.random.default_rng(7).standard_normal(u.size)
    return recorded(folder / "noisy", MOTOR, u, true + noise), true


def test_a_stretch_that_starts_afresh_is_met_by_all_its_samples_and_by_no_other(tmp_path: Path) -> None:
    recording, true = noisy_motor(tmp_path)
    twin = make(recording)
    theta, ranges = twin.start(recording), ((0, 200), (220, 600))
    inside = np.r_[40:200, 260:600]

    def left(recording: Recording, afresh: bool) -> float:
        view = View(recording, ranges, 40, afresh=afresh)
        whole = Model(twin).whole(view, theta)["angle"]
        return float(np.sqrt(np.mean((whole - true)[inside] ** 2)))

    # two numbers from 200 and 380 samples of 10 mrad: 0.01 * sqrt(4 / 580) = 0.8 mrad; speed and angle from 40 more
    assert left(recording, True) < 1.3e-3 < left(recording, False)
    gap = recording.outputs["angle"].copy()
    gap[200:220] += 5.0
    beside = replace(recording, outputs={"angle": gap})
    assert left(beside, True) == pytest.approx(left(recording, True), rel=1e-6)


LINEAR_TANKS = """
[twin]
kind = "ode"
[twin.states]
upper = { unit = "m", start = 1.0 }
level = { unit = "m", start = 1.0 }
[twin.equations]
upper = "gain * command - a * upper - deficit"
level = "a * upper - b * level + surplus"
[twin.parameters]
gain = 20.0
a = 7.0
b = 7.0
deficit = 7.0
surplus = 0.0
"""


def test_flows_begin_in_place_of_the_linear_terms_that_are_their_tangents(tmp_path: Path) -> None:
    channels = CHANNELS.replace('"angle"', '"level"').replace('"rad"', '"m"')
    u = 0.7 + 0.5 * command()
    t = np.arange(u.size) / RATE_HZ

    def slopes(now: float, h: np.ndarray) -> list[float]:
        top, low = np.sqrt(max(h[0], 0.0)), np.sqrt(max(h[1], 0.0))
        return [20 * np.interp(now, t, u) - 14 * top, 14 * top - 14 * low]

    exact = solve_ivp(slopes, (0, t[-1]), [1.0, 1.0], t_eval=t, rtol=1e-9, atol=1e-9, max_step=0.5 / RATE_HZ).y
    recording = recorded(tmp_path, LINEAR_TANKS, u, exact[1], channels)
    tanks = make(recording)
    view = View.whole(recording)
    linear = Model(tanks)
    given = linear.start(recording)
    root = next(p for p in sites(tanks, recording, EFFECTS["square_root_outflow"]) if p.target == "upper+level")
    root = prepare(linear, view, given, root)
    model = Model(tanks, [root])
    theta = model.carry(linear, given, recording)
    theta[model.slices(0)[0]] = 0.0
    start = flow_starts(model, 0, view, theta, "level")[0]
    assert np.all(start[model.slices(0)[1]] > 8.0)  # the roots carry the flow,
    assert np.all(np.abs(start[[1, 2]]) < 3.0)  # and the linear terms do not
    before = float(np.std(linear.residual(view, given)["level"]))
    assert float(np.std(model.residual(view, start)["level"])) < 0.5 * before
