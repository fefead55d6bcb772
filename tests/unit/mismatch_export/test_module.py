"""An exported module runs as the engine does: every twin kind, every effect of the vocabulary at every place.

Tolerance: 1e-6 of the output's standard deviation over the whole free run (1e-4 where dry friction may stop one step
earlier or later).
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hal import plugins
from hal.arrays import Array
from hal.trust import trust_package
from sim_devices.physics import hysteresis
from sim_devices.physics.catalogue import EFFECTS
from sim_devices.physics.effect import Effect
from tests.unit.mismatch_model.made import recording
from tools.mismatch.apply import EVENTS, Corrected
from tools.mismatch.export.run import whole_run
from tools.mismatch.export.write import module_of
from tools.mismatch.placed import Placed
from tools.mismatch.recording import Recording
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_sites import sites
from tools.mismatch.simulate_start import prepare
from tools.mismatch.simulate_view import View
from tools.mismatch.twins.make import make

N, DT = 320, 4e-3


def wave(k: float = 0) -> Array:
    t = np.arange(N) * DT
    return np.sin(2 * np.pi * (0.9 + 0.3 * k) * t + k) + 0.5 * np.sin(2 * np.pi * (4.3 + k) * t)


CONTEXT = {"temperature": 25 + wave(5), "supply": 5 + 0.1 * wave(6), "actuator_current": wave(7)}
CONTEXT_UNITS = {"temperature": "degC", "supply": "V", "actuator_current": "A"}


def piezo() -> Recording:
    units = {"command": "V", "displacement": "um", **CONTEXT_UNITS}
    u = 50 + 20 * wave()
    given = {"gain_um_per_V": 0.125, "offset_um": -1.0}
    return recording("piezo_stack", DT, {"command": u}, {"displacement": 0.13 * u + 0.4}, units, given, CONTEXT)


def axes(kind: str, prefix: str, unit: str, given: dict[str, Any]) -> Recording:
    inputs = {f"{prefix}_{a}": wave(i) for i, a in enumerate("xyz")}
    outputs = {f"voltage_{a}": 2.5 + wave(i) for i, a in enumerate("xyz")}
    units = {**dict.fromkeys(inputs, unit), **dict.fromkeys(outputs, "V"), **CONTEXT_UNITS}
    return recording(kind, DT, inputs, outputs, units, given, CONTEXT)


def accelerometer() -> Recording:
    return axes("accelerometer", "specific_force", "g", {"bias_V": [2.4, 2.5, 2.6], "scale_V_per_g": 1.0})


def magnetometer() -> Recording:
    return axes("magnetometer", "field", "uT", {"bias_V": 2.5, "scale_V_per_uT": 0.02})


def cluster() -> Recording:
    inputs = {f"specific_force_{a}": wave(i) for i, a in enumerate("xyz")}
    inputs |= {f"angular_rate_{a}": wave(i + 3) for i, a in enumerate("xz")}
    outputs = {f"accel_{i}{a}": wave(j) for i in (1, 2) for j, a in enumerate("xyz")}
    units = {s: "rad/s" if s.startswith("ang") else "m/s^2" for s in (*inputs, *outputs)}
    given = {"positions_m": {"1": [0.01, 0.02, 0.03], "2": [-0.02, 0.0, 0.05]}}
    return recording("accelerometer_cluster", DT, inputs, outputs, {**units, **CONTEXT_UNITS}, given, CONTEXT)


def axis(outputs: tuple[str, ...], stiffness: float = 800.0, hold: str = "linear") -> Recording:
    units = {"force": "N", "position": "m", "velocity": "m/s", **CONTEXT_UNITS}
    given = {"mass": 2.0, "damping": 9.0, "stiffness": stiffness, "offset_force": 0.1, "hold": hold}
    both = {"position": 1e-3 * wave(1), "velocity": np.gradient(1e-3 * wave(1), DT)}
    rec = recording("mechanical_axis", DT, {"force": wave()}, {o: both[o] for o in outputs}, units, given, CONTEXT)
    model = Model(make(rec))
    return replace(rec, outputs=model.simulate(View.whole(rec, 40), model.start(rec)))


def state_space(**changes: Any) -> Recording:
    given = {"A": [[0.0, 1.0], [-900.0, -8.0]], "B": [[0.0], [1.0]], "C": [[900.0, 0.0]], "y0": [0.2], **changes}
    units = {"u": "V", "y": "V", **CONTEXT_UNITS}
    return recording("state_space", DT, {"u": wave()}, {"y": wave()}, units, given, CONTEXT)


def several() -> Recording:
    given = {"A": [[-3.0, 1.0, 0.0], [-90.0, -8.0, 0.0], [0.0, 2.0, -20.0]]}
    given |= {"B": [[0.0, 1.0], [1.0, 0.0], [0.0, 0.5]], "C": [[9.0, 0.0, 1.0], [0.0, 1.0, 0.0]]}
    given |= {"D": [[0.0, 0.1], [0.0, 0.0]], "hold": "zero", "x0": [0.1, 0.0, 0.2]}
    inputs, outputs = {"u": wave(), "w": wave(2)}, {"y": wave(1), "z": wave(3)}
    return recording("state_space", DT, inputs, outputs, dict.fromkeys(("u", "w", "y", "z"), "V"), given)


def equations(table: dict[str, Any], inputs: tuple[str, ...], outputs: tuple[str, ...], units: str) -> Recording:
    """A twin of equations, its outputs those of a run as given."""
    signals = {s: wave(i) for i, s in enumerate(inputs)}
    every = {**dict.fromkeys(inputs, "V"), **dict.fromkeys(outputs, units), **CONTEXT_UNITS}
    rec = recording("ode", DT, signals, {o: wave(i) for i, o in enumerate(outputs)}, every, table, CONTEXT)
    model = Model(make(rec))
    return replace(rec, outputs=model.simulate(View.whole(rec, 40), model.start(rec)))


def motor(**changes: Any) -> Recording:
    table: dict[str, Any] = {"states": {"angle": "rad", "s": {"unit": "rad/s", "start": 1.0}}}
    table["equations"] = {"angle": "s", "s": "(gain * volts - s - 3*sin(angle)) / lag"}
    return equations({**table, "gain": 20.0, "lag": 0.05, **changes}, ("volts",), ("angle",), "rad")


def tanks() -> Recording:
    table: dict[str, Any] = {"states": {"upper": {"unit": "V", "start": 3.0, "min": 0.0}, "lower": "V"}}
    table["equations"] = {
        "upper": "inflow*(pump + 2) - drain*upper",
        "lower": "drain*upper - (drain if lower > 0.5 else 0.5*drain)*lower + 0.01*temperature - max(lower, -1)**2",
    }
    table["outputs"] = {"level": "lower", "both": "upper + 0.1*pump*lower - drain*(lower - 1)"}
    return equations({**table, "inflow": 1.5, "drain": 0.8, "hold": "zero"}, ("pump",), ("level", "both"), "V")


def heater(unit: str) -> Recording:
    """A plate that is heated, in degC or K."""
    table: dict[str, Any] = {"states": {"plate": {"unit": unit, "start": 300.0}}}
    table["equations"] = {"plate": "volts - loss*(plate - 290)"}
    return equations({**table, "loss": 0.4}, ("volts",), ("plate",), unit)


def two_bodies() -> Recording:
    """Two bodies with a spring between them; an effect may be in that joint."""
    states = {"motor": "rad", "w_1": "rad/s", "load": "rad", "w_2": "rad/s"}
    pull = "stiffness * (motor - 2*load)"
    rates = {"w_1": f"(volts - w_1 - {pull}) / 0.05", "w_2": f"(2*{pull} - w_2 - sin(load)) / 0.2"}
    table: dict[str, Any] = {"states": states, "equations": {"motor": "w_1", "load": "w_2", **rates}}
    return equations({**table, "stiffness": 20.0}, ("volts",), ("motor", "load"), "rad")


def in_two() -> Recording:
    """Two filters in a row; effects may stand between them."""
    first = {"A": [[-40.0]], "B": [[40.0]], "C": [[0.9]], "D": [[0.1]]}
    return state_space(first=first, D=[[0.3]])


def columns() -> Recording:
    inputs, units = {"simulated_level": wave(1)}, {"simulated_level": "V", "level": "V", **CONTEXT_UNITS}
    return recording("columns", DT, inputs, {"level": wave()}, units, {"offset": 0.1, "scale": 1.2}, CONTEXT)


TWINS: dict[str, Callable[[], Recording]] = {
    "piezo_stack": piezo,
    "accelerometer": accelerometer,
    "magnetometer": magnetometer,
    "accelerometer_cluster": cluster,
    "axis position": lambda: axis(("position",)),
    "axis both": lambda: axis(("position", "velocity"), hold="zero"),
    "axis smooth": lambda: axis(("position",), hold="smooth"),
    "axis velocity": lambda: axis(("velocity",)),
    "axis free": lambda: axis(("velocity",), stiffness=0.0),
    "state_space": state_space,
    "state_space biproper": lambda: state_space(D=[[0.3]], C=[[900.0, 4.0]]),
    "state_space discrete": lambda: state_space(
        A=[[0.9, 0.1], [-0.2, 0.95]], B=[[0.0], [0.1]], C=[[1.0, 0.0]], discrete=True
    ),
    "state_space smooth": lambda: state_space(D=[[0.3]], hold="smooth"),
    "state_space several": several,
    "state_space in two": in_two,
    "columns": columns,
    "ode motor": motor,
    "ode tanks": tanks,
    "ode two bodies": two_bodies,
    "ode heater": lambda: heater("degC"),
    "ode heater in K": lambda: heater("K"),
}


@cache
def made(kind: str) -> Recording:
    """The recording of one kind, made once."""
    return TWINS[kind]()


FORMS = [(n, i, f) for n, e in EFFECTS.items() if n not in EVENTS for i, f in enumerate((e, *e.variants))]


def corrected(rec: Recording, placed: list[Placed], seed: int = 1) -> Corrected:
    """A twin with these effects, at random parameters of a size that shows."""
    model = Model(make(rec), placed)
    rng = np.random.default_rng(seed)
    theta = model.start(rec)
    for i, p in enumerate(model.parameters):
        if p.placed < 0:
            continue
        if np.isfinite(p.hi - p.lo) and p.lo > 0:
            theta[i] = p.lo * (p.hi / p.lo) ** rng.uniform(0.35, 0.65)
        elif np.isfinite(p.hi - p.lo):
            theta[i] = p.lo + (p.hi - p.lo) * rng.uniform(0.3, 0.7)
        else:
            # a force of this size would throw a plant with so small a gain from one side to the other
            size = 5e-5 if rec.twin.parameters.get("discrete") and model.placed[p.placed].site == "feedback" else 0.05
            theta[i] = size * p.scale * rng.standard_normal()
            theta[i] = abs(theta[i]) if p.lo == 0.0 else theta[i]
    # a force that throws the plant to infinity says nothing
    while not all(np.all(np.isfinite(y)) for y in whole_run(rec, model, theta).values()):
        for k in range(len(placed)):
            theta[model.slices(k)[1]] *= 0.1
    return Corrected(rec.twin.kind, "", (), (), rec, model, theta)


def run(twin: Corrected) -> tuple[dict[str, Array], dict[str, Array], str]:
    """(the engine's run, the module's run, the module)."""
    text = module_of(twin, {"physics": [], "fit": {}})
    space: dict[str, Any] = {}
    exec(compile(text, "twin.py", "exec"), space)
    found = space["simulate"](dict(twin.recording.signals))
    return whole_run(twin.recording, twin.model, twin.theta), found, text


def same(twin: Corrected, tolerance: float = 1e-6) -> str:
    wanted, found, text = run(twin)
    for o, y in wanted.items():
        np.testing.assert_allclose(found[o], y, rtol=0, atol=tolerance * float(np.std(y)), err_msg=o)
    return text


def placements(rec: Recording, form: Effect) -> list[Placed]:
    twin = make(rec)
    base = Model(twin)
    view = View.whole(rec, 20)
    found = []
    for place in sites(twin, rec, EFFECTS[form.name]):
        if place.effect.kind == form.kind and (place.effect.equation == form.equation or form.kind != "feedback"):
            found.append(prepare(base, view, base.start(rec), replace(place, effect=form)))
    return found


@pytest.mark.parametrize("kind", TWINS)
def test_the_base_alone(kind: str) -> None:
    same(corrected(made(kind), []))


@pytest.mark.parametrize("hold", [{"u": "zero"}, {"u": "linear", "w": "zero"}, {"u": "zero", "w": "smooth"}])
def test_each_input_keeps_its_hold(hold: dict[str, str]) -> None:
    rec = several()
    given = {k: v for k, v in rec.twin.parameters.items() if k != "hold"}
    same(corrected(replace(rec, twin=replace(rec.twin, parameters={**given, "hold": hold})), []))


@pytest.mark.parametrize("rate", [3.0, 400.0])  # of one and of several steps per sample
def test_each_input_of_equations_keeps_its_hold(rate: float) -> None:
    table: dict[str, Any] = {"states": {"x": "V"}, "equations": {"x": "rate * (heat + 0.5*air - x - 0.1*x**3)"}}
    same(corrected(equations({**table, "rate": rate, "hold": {"heat": "zero"}}, ("heat", "air"), ("x",), "V"), []))


@pytest.mark.parametrize("eighth", [0, *(pytest.param(q, marks=pytest.mark.slow) for q in range(1, 8))])
@pytest.mark.parametrize(("name", "index", "form"), FORMS, ids=[f"{n} {i}" for n, i, _ in FORMS])
def test_every_effect_at_every_place_of_every_twin(name: str, index: int, form: Effect, eighth: int) -> None:
    """An eighth of the places by default, the others with the slow tests."""
    places = [(kind, place) for kind in TWINS for place in placements(made(kind), form)]
    assert places
    for kind, place in places[(eighth + index) % 8 :: 8]:
        try:
            same(corrected(made(kind), [place]), 1e-4 if "friction" in name else 1e-6)
        except AssertionError as error:
            raise AssertionError(f"{kind}, {place.label} at {place.site}: {error}") from error


@pytest.mark.parametrize("form", range(len(hysteresis.FORMS)))
@pytest.mark.parametrize("before", [None, 20.0])
@pytest.mark.parametrize("wide", [0.0, 1.0])
def test_every_form_of_hysteresis(form: int, before: float | None, wide: float) -> None:
    rec = piezo()
    place = placements(rec, EFFECTS["hysteresis"])[0]
    more = {} if before is None else {"before": (before,)}
    settings = {**{k: v for k, v in place.settings.items() if k != "before"}, "form": (float(form),), **more}
    same(corrected(rec, [replace(place, settings={**settings, "wide": (wide,)})]))


LEVER = '''"""A user's twin: nothing of its inside is known."""

import numpy as np


class Lever:
    def simulate(self, inputs, parameters):
        angle = parameters["rad_per_V"] * inputs["drive"]
        return {"lift": parameters["offset"] + parameters["arm"] * np.sin(angle)}
'''


def test_a_program_of_the_users_is_wrapped(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Effects around it are written out; the program itself is imported, or given as ``base``."""
    (tmp_path / "lever_arm.py").write_text(LEVER)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    trust_package("lever_arm:Lever")
    kinds = {"lever": EntryPoint("lever", "lever_arm:Lever", plugins.TWINS)}
    monkeypatch.setattr("tools.mismatch.twins.core.find_user_kind", kinds.get)
    monkeypatch.setattr("tools.mismatch.export.module.find_user_kind", kinds.get)
    given = {"arm": 3.0, "rad_per_V": 0.4, "offset": 0.1}
    rec = recording("lever", DT, {"drive": wave()}, {"lift": wave()}, {"drive": "V", "lift": "um"}, given)
    twin = corrected(rec, [*placements(rec, EFFECTS["backlash"])[:1], *placements(rec, EFFECTS["first_order_lag"])[:1]])
    text = module_of(twin, {})
    assert "from lever_arm import Lever" in text
    space: dict[str, Any] = {}
    exec(compile(text, "twin.py", "exec"), space)
    found = space["simulate"](dict(rec.signals), base=importlib.import_module("lever_arm").Lever().simulate)["lift"]
    wanted = whole_run(rec, twin.model, twin.theta)["lift"]
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-9)


def test_units_are_those_of_the_file() -> None:
    """mV and nm in the data, V and um in the twin: inputs and outputs of the module are mV and nm."""
    rec = piezo()
    rec = replace(rec, declared_unit={"command": "mV", "displacement": "nm", "temperature": "K"})
    twin = corrected(rec, placements(rec, EFFECTS["temperature_sensitivity"])[:1])
    space: dict[str, Any] = {}
    exec(compile(module_of(twin, {}), "twin.py", "exec"), space)
    inputs = {"command": 1e3 * rec.inputs["command"], "temperature": 273.15 + rec.context["temperature"]}
    found = space["simulate"](inputs)["displacement"]
    wanted = 1e3 * whole_run(rec, twin.model, twin.theta)["displacement"]
    np.testing.assert_allclose(found, wanted, rtol=1e-9)


def test_sample_by_sample_is_the_whole_record() -> None:
    """What an FMU does: every effect with memory goes on where its last call stopped."""
    rec = piezo()
    names = ("hysteresis", "creep", "slew_limit", "first_order_lag", "ac_coupling", "resonance", "backlash")
    twin = corrected(rec, [placements(rec, EFFECTS[n])[0] for n in names])
    space: dict[str, Any] = {}
    exec(compile(module_of(twin, {}), "twin.py", "exec"), space)
    t, u = rec.t, dict(rec.signals)
    whole = space["twin"](space["PARAMETERS"], DT)(t, u)["displacement"]
    run = space["twin"](space["PARAMETERS"], DT)
    single = [run(t[k : k + 1], {s: x[k : k + 1] for s, x in u.items()})["displacement"][0] for k in range(N)]
    np.testing.assert_allclose(single, whole, rtol=0, atol=1e-12 * float(np.max(np.abs(whole))))
