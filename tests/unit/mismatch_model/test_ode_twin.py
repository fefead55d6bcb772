"""Twins of differential equations: a free run is the solution; other sources of equations; bad input."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hal.trust import trust_program
from sim_devices.physics.catalogue import EFFECTS
from sim_devices.physics.effect import Settings
from tests.recording_text import channel
from tests.unit.mismatch_model.ode_systems import CHANNELS, MOTOR, RATE_HZ, command, pendulum, recorded
from tools.errors import RecordingError
from tools.mismatch.engine.reach import not_tried
from tools.mismatch.recording_load import load
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_sites import sites
from tools.mismatch.simulate_start import prepare, starts
from tools.mismatch.simulate_view import View
from tools.mismatch.twins.make import make
from tools.mismatch.twins.ode import OdeTwin


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
        (
            ("tau  = 0.08", "tau  = 0.08\nfixed = ['tau', 'gian']"),
            r"fixed: parameter 'gian' is unknown; write 'gain', or leave it out\. Known parameters: gain, tau",
        ),
        (("tau  = 0.08", "tau  = 0.08\nfixed = 'tau'"), "fixed must list parameters that stay as given, by"),
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
    a, b = (Model(make(r)).simulate(View.whole(r), np.array([20.0, 0.08, 0.0]))["angle"] for r in (one, other))
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
    assert [p.name for p in other.twin.parameters] == ["A_2_1", "A_2_2", "B_2_1", "angle_offset"]
    place = sites(other.twin, named, EFFECTS["coulomb_friction"])[0]
    assert (place.site, place.target) == ("feedback", "speed")
    text = other.twin.to_text(other.start(named) * 2.0)
    assert text["A"] == [[0.0, 1.0], [-60.0, -0.8]]
    assert text["states"] == {"angle": "rad", "speed": "rad/s"}


def test_columns_of_simulated_output_are_a_twin_that_says_what_could_not_be_tried(tmp_path: Path) -> None:
    u = command()
    columns = channel("u", "input", "simulated_angle", "rad") + channel("y", "output", "angle", "rad")
    recording = recorded(tmp_path, '[twin]\nkind = "columns"\n', u, 1.02 * u + 0.1, columns)
    twin = make(recording)
    model = Model(twin)
    residual = model.residual(View.whole(recording), model.start(recording))["angle"]
    assert np.allclose(residual, 0.02 * u + 0.1)
    assert "kind 'ode'" in not_tried(twin)
    assert not sites(twin, recording, EFFECTS["coulomb_friction"])
    for name in ("backlash", "slew_limit", "dead_zone", "saturation", "resonance"):
        assert sites(twin, recording, EFFECTS[name]), f"{name} may be between simulated columns and recorded ones"
    assert {p.site for p in sites(twin, recording, EFFECTS["backlash"])} == {"output"}
    assert not_tried(make(recorded(tmp_path / "motor", MOTOR, u, u**2))) == ""
    with pytest.raises(RecordingError, match="simulated_angle"):
        make(recorded(tmp_path / "bad", '[twin]\nkind = "columns"\n', u, u**2))


TEMPERATURE = '\n[[channels]]\ncolumn = "T"\nrole = "context"\nsignal = "temperature"\nunit = "degC"\n'


@pytest.mark.parametrize(
    ("law", "place", "settings", "weights"),
    [
        ("1 + 0.05 * (temperature - 25)", "tau by temperature", {"centre": (25.0,), "spread": (5.0,)}, [0.05]),
        (
            "exp(0.02 * (speed - 0.5) - 0.001 * (speed - 0.5)**2)",
            "tau by speed",
            {"centre": (0.5,), "spread": (1.0,), "range": (-1.0, 1.0)},
            [0.02, -0.001],
        ),
    ],
)
def test_a_parameter_may_follow_a_signal_or_a_state(
    tmp_path: Path, law: str, place: str, settings: Settings, weights: list[float]
) -> None:
    """The effect does what the same law written into the equations does; outputs that have the parameter follow."""
    u = command()
    warm = 20.0 + 15.0 * np.linspace(0.0, 1.0, u.size) ** 2
    np.savez(tmp_path / "data.npz", u=u, y=0.1 * u[::-1], T=warm)
    head = f'format = 1\ndata = "data.npz"\nrate_hz = {RATE_HZ}\n'
    found: list[np.ndarray] = []
    for tau in ("tau", f"(tau * ({law}))"):
        read = f'[twin.outputs]\nangle = "angle + 0.1 * {tau} * speed"\n'
        text = head + MOTOR.replace("/ tau", f"/ {tau}") + read + CHANNELS + TEMPERATURE
        (tmp_path / "recording.toml").write_text(text)
        recording = load(tmp_path)
        twin = make(recording)
        assert isinstance(twin, OdeTwin)
        theta = np.array([20.0, 0.08, 0.0])
        found.append(Model(twin).simulate(View.whole(recording), theta)["angle"])
        if tau == "tau":
            here = {p.target: p for p in sites(twin, recording, EFFECTS["parameter_variation"])}
            pairs = twin.place(place).pairs
            model = Model(twin, [replace(here[place], settings={**settings, "pairs": pairs})])
            found.append(model.simulate(View.whole(recording), np.array([*theta, *weights]))["angle"])
    plain, by_effect, written = found
    assert np.allclose(by_effect, written, rtol=0, atol=1e-12)
    assert np.std(plain - written) > 0.01


def test_a_parameter_follows_no_state_where_constant_ones_do_the_same(tmp_path: Path) -> None:
    """``a (1 + c T) - b T`` is another ``b``, and ``b`` and ``d`` stand for each other."""
    cooling = """
[twin]
kind = "ode"
[twin.states]
angle = "rad"
[twin.equations]
angle = "a + command - b * d * angle"
[twin.parameters]
a = 0.3
b = 2.0
d = 1.5
"""
    recording = recorded(tmp_path, cooling, command(), 0.1 * command())
    targets = [p.target for p in sites(make(recording), recording, EFFECTS["parameter_variation"])]
    assert targets == ["b by angle"]


def test_the_zero_of_a_sensor_is_a_parameter_and_written(tmp_path: Path) -> None:
    """An offset is re-fitted as the closed form has it, goes into the corrected twin and comes back."""
    u = command()
    recording = recorded(tmp_path, MOTOR, u, 0.1 * u[::-1])
    twin = make(recording)
    assert [p.name for p in twin.parameters] == ["gain", "tau", "angle_offset"]
    theta = np.array([20.0, 0.08, 0.7])
    plain, moved = (Model(twin).simulate(View.whole(recording), t)["angle"] for t in (theta * [1, 1, 0], theta))
    np.testing.assert_allclose(moved - plain, 0.7, rtol=0, atol=1e-12)
    text = twin.to_text(theta)
    assert text["offsets"] == {"angle": 0.7}
    again = make(replace(recording, twin=replace(recording.twin, parameters=text)))
    np.testing.assert_array_equal(again.start(recording), theta)
    wrong = replace(recording, twin=replace(recording.twin, parameters={**text, "offsets": {"speed": 1.0}}))
    with pytest.raises(RecordingError, match=r"offsets must give a number for an output \(angle\), got"):
        make(wrong)


@pytest.mark.parametrize("name", ["step_shift", "hysteresis", "resonance", "static_nonlinearity", "linear_loss"])
def test_an_effect_can_be_prepared_beside_a_simulation_that_diverges(tmp_path: Path, name: str) -> None:
    """A set of effects may run away where it is not scored; the search beside it goes on."""
    recording = recorded(tmp_path, MOTOR, command(), 0.1 * command()[::-1])
    model, view = Model(make(recording)), View.whole(recording)
    away = np.array([20.0, -1e-3, 0.0])
    with np.errstate(all="ignore"):
        assert not np.all(np.isfinite(model.whole(view, away)["angle"]))
        for place in sites(model.twin, recording, EFFECTS[name]):
            placed = prepare(model, view, away, place)
            assert all(np.all(np.isfinite(v)) for v in placed.settings.values())


def test_a_parameter_that_has_the_name_of_an_offset_stays_the_engineers(tmp_path: Path) -> None:
    u = command()
    mine = MOTOR.replace("[twin.parameters]", "[twin.parameters]\nangle_offset = 0.3")
    recording = recorded(tmp_path, mine, u, 0.1 * u[::-1])
    twin = make(recording)
    assert sorted(p.name for p in twin.parameters) == ["angle_offset", "gain", "tau"]
    assert "offsets" not in twin.to_text(twin.start(recording))


def test_a_parameter_may_differ_with_the_direction_of_a_state(tmp_path: Path) -> None:
    """A tank that fills and empties by different time constants: exponentials of the closed form at a held input."""
    tank = """
[twin]
kind = "ode"
[twin.states]
level = "m"
[twin.equations]
level = "(feed - level) / tau"
[twin.parameters]
tau = 0.2
hold = "zero"
"""
    channels = CHANNELS.replace('"command"', '"feed"').replace('"angle"', '"level"').replace('"rad"', '"m"')
    u = np.repeat(np.array([1.0, 0.2, 0.7, -0.5, 0.0]), 60)
    recording = recorded(tmp_path, tank, u, 0.1 * u[::-1], channels)
    twin = make(recording)
    (place,) = sites(twin, recording, EFFECTS["direction_dependence"])
    assert place.target == "tau by direction of level"
    pairs = twin.place(place.target).pairs  # type: ignore[attr-defined]
    model = Model(twin, [replace(place, settings={"pairs": pairs})])
    theta = np.append(model.start(recording)[:-1], -0.4)
    found = model.simulate(View.whole(recording), theta)["level"]
    exact = np.zeros(u.size)
    exact[0] = found[0]
    for k in range(1, u.size):
        tau = 0.2 * (1 - 0.4 * np.sign(u[k - 1] - exact[k - 1]))
        exact[k] = u[k - 1] + (exact[k - 1] - u[k - 1]) * np.exp(-1 / RATE_HZ / tau)
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-5)
    assert {h.name: h.value for h in model.human(theta)[place.label]}["rising_to_falling"] == pytest.approx(0.6 / 1.4)


def test_a_parameter_may_differ_with_the_sign_of_a_velocity(tmp_path: Path) -> None:
    """A cylinder whose two areas differ: exponentials of the closed form; a turn costs at most half a step of the wrong
    rate, which is forgotten with the time constant.
    """
    cylinder = """
[twin]
kind = "ode"
[twin.states]
speed = "m/s"
[twin.equations]
speed = "(gain * valve - speed) / tau"
[twin.parameters]
gain = 2.0
tau = 0.2
hold = "zero"
"""
    channels = CHANNELS.replace('"command"', '"valve"').replace('"angle"', '"speed"').replace('"rad"', '"m/s"')
    u = np.repeat(np.array([1.0, 0.2, -0.7, -0.5, 0.6]), 60)
    recording = recorded(tmp_path, cylinder, u, 0.1 * (u - 0.3), channels)
    twin = make(recording)
    here = [p for p in sites(twin, recording, EFFECTS["direction_dependence"]) if p.target == "gain by sign of speed"]
    pairs = twin.place(here[0].target).pairs  # type: ignore[attr-defined]
    model = Model(twin, [replace(here[0], settings={"pairs": pairs})])
    theta = np.append(model.start(recording)[:-1], -0.4)
    found = model.simulate(View.whole(recording), theta)["speed"]
    v, allowed = found[0], 1e-9
    for k in range(1, u.size):
        allowed *= np.exp(-1 / RATE_HZ / 0.2)
        left, way = 1 / RATE_HZ, np.sign(v) or np.sign(u[k - 1])
        goal = 2.0 * (1 - 0.4 * way) * u[k - 1]
        to_zero = 0.2 * np.log(1 - v / goal) if v * goal < 0 else np.inf
        if to_zero < left or v == 0.0:
            allowed += 0.5 / RATE_HZ * 2.0 * 0.8 * abs(u[k - 1]) / 0.2
        if to_zero < left:
            left, v, goal = left - to_zero, 0.0, 2.0 * (1 + 0.4 * way) * u[k - 1]
        v = goal + (v - goal) * np.exp(-left / 0.2)
        assert found[k] == pytest.approx(v, abs=allowed + 1e-8)


def test_a_velocity_differs_with_the_direction_of_its_position(tmp_path: Path) -> None:
    recording, _ = pendulum(tmp_path)
    places = [p.target for p in sites(make(recording), recording, EFFECTS["direction_dependence"])]
    assert places
    assert all(p.endswith("by direction of angle") for p in places)


def test_a_belief_that_runs_away_behind_the_view_gives_no_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A base may diverge beside other effects: as exp(t / 8 ms) it is finite in the view, and no number at the end."""
    u = command()
    recording = recorded(tmp_path, MOTOR, u, 0.1 * u[::-1])
    twin = make(recording)
    drifting = [p for p in sites(twin, recording, EFFECTS["clock_skew"]) if len(p.parts.nonlinear) == 2]
    model = Model(twin, [replace(drifting[0], settings={"time": (1 / RATE_HZ, u.size / RATE_HZ)})])
    theta = model.start(recording)
    away = twin.start(recording)
    away[[p.name for p in twin.parameters].index("tau")] = -0.008
    monkeypatch.setattr(type(twin), "start", lambda *_: away)
    with np.errstate(all="ignore"):
        found = starts(model, 0, View(recording, ((0, 480),)), theta)
    assert found
    assert np.all(np.isfinite(found))


def test_equations_that_grow_beyond_all_numbers_are_no_crash(tmp_path: Path) -> None:
    """A search may try a time constant of the wrong sign and next to nothing: the run is not finite, and no error."""
    recording = recorded(tmp_path, MOTOR, command(), 0.1 * command()[::-1])
    found = Model(make(recording)).simulate(View.whole(recording), np.array([20.0, -1e-6, 0.0]))["angle"]
    assert not np.any(np.isfinite(found))


def test_what_is_divided_by_is_searched_by_its_size_and_what_may_change_its_sign_is_not(tmp_path: Path) -> None:
    twin = """
[twin]
kind = "ode"
[twin.states]
angle = "rad"
speed = "rad/s"
[twin.equations]
angle = "speed"
speed = "(torque * command - drag * speed - weight * sin(angle + upright)) / inertia + sqrt(leak)"
[twin.parameters]
torque = 2.0
drag = 0.5
weight = 0.3
upright = 0.05
inertia = 0.02
leak = 0.1
"""
    u = command()
    parameters = {p.name: p for p in make(recorded(tmp_path, twin, u, 2.0 * u)).parameters}
    assert {name for name, p in parameters.items() if p.log} == {"inertia", "leak"}
    assert (parameters["inertia"].lo, parameters["inertia"].hi) == pytest.approx((2e-4, 2.0))
    assert parameters["upright"].lo == -np.inf
