"""Models of a twin with effects: design and simulation agree, parameters are sorted right, text round trip."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hal.arrays import Array
from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_model.made import recording
from tools.errors import RecordingError
from tools.mismatch.placed import Placed
from tools.mismatch.recording import Recording, TwinText
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_sites import sites, why_not
from tools.mismatch.simulate_start import prepare
from tools.mismatch.simulate_text import describe, restore
from tools.mismatch.simulate_view import View
from tools.mismatch.twins.feedback import FASTEST
from tools.mismatch.twins.make import make

N, DT = 1200, 2e-3


def wave(k: int = 0) -> Array:
    t = np.arange(N) * DT
    return np.sin(2 * np.pi * (0.9 + 0.3 * k) * t + k) + 0.5 * np.sin(2 * np.pi * (4.3 + k) * t)


def piezo() -> Recording:
    u = 50 + 20 * wave()
    y = 0.13 * u + 0.4 + 0.02 * np.random.default_rng(0).standard_normal(N)
    units = {"command": "V", "displacement": "um", "temperature": "degC"}
    context = {"temperature": 25 + 0.1 * wave(1)}
    given = {"gain_um_per_V": 0.125}
    return recording("piezo_stack", DT, {"command": u}, {"displacement": y}, units, given, context)


def axis() -> Recording:
    units = {"force": "N", "position": "m"}
    given = {"mass": 2.0, "damping": 9.0, "stiffness": 800.0}
    rec = recording("mechanical_axis", DT, {"force": wave()}, {"position": 1e-3 * wave(1)}, units, given)
    model = Model(make(rec))
    y = model.simulate(View.whole(rec, 40), model.start(rec))["position"]
    noise = 1e-6 * np.random.default_rng(0).standard_normal(N)
    return recording("mechanical_axis", DT, {"force": wave()}, {"position": y + noise}, units, given)


def oscillator() -> Recording:
    given = {"A": [[0.0, 1.0], [-900.0, -8.0]], "B": [[0.0], [1.0]], "C": [[900.0, 0.0]]}
    return recording("state_space", DT, {"u": wave()}, {"y": wave()}, {}, given)


def accelerometer() -> Recording:
    inputs = {f"specific_force_{a}": wave(i) for i, a in enumerate("xyz")}
    outputs = {f"voltage_{a}": 2.5 + wave(i) for i, a in enumerate("xyz")}
    units = {**dict.fromkeys(inputs, "g"), **dict.fromkeys(outputs, "V")}
    return recording("accelerometer", DT, inputs, outputs, units, {"bias_V": 2.5, "scale_V_per_g": 1.0})


def place(rec: Recording, name: str, index: int = 0) -> Placed:
    base = Model(make(rec))
    view = View.whole(rec, 20)
    return prepare(base, view, base.start(rec), sites(base.twin, rec, EFFECTS[name])[index])


CASES = [
    (piezo, ("hysteresis", "first_order_lag", "mains_interference")),
    (piezo, ("creep", "resonance", "temperature_sensitivity", "dead_time")),
    (piezo, ("saturation", "backlash")),
    (piezo, ("hysteresis", "quantization")),
    (axis, ("creep", "dead_time")),
    (axis, ("coulomb_friction", "thermal_drift")),
    (oscillator, ("hysteresis", "static_nonlinearity")),
    (oscillator, ("cubic_stiffness",)),
    (accelerometer, ("misalignment", "scale_factor_variation", "dead_time", "saturation")),
]


@pytest.mark.parametrize(("make_one", "names"), CASES, ids=["+".join(n) + "/" + m.__name__ for m, n in CASES])
def test_design_is_the_simulation(make_one: object, names: tuple[str, ...]) -> None:
    """constant + columns @ linear parameters equals the free run, and the linear ones are really linear.

    Where start states are read behind a curve or a loop they are to first order: what is left is of second order.
    """
    assert callable(make_one)
    rec = make_one()
    model = Model(make(rec), [place(rec, n, -1 if n == "hysteresis" else 0) for n in names])
    view = View(rec, ((100, 700), (900, 1200)), 20)
    rng = np.random.default_rng(1)
    theta = model.start(rec)
    for i, p in enumerate(model.parameters):
        if p.placed >= 0 and not np.isfinite(p.hi - p.lo):
            theta[i] = 1e-3 * abs(p.scale) * rng.standard_normal()
    design = model.design(view, theta)
    run = model.simulate(view, theta)
    for o, y in run.items():
        found = design.constant[o] + design.columns[o] @ theta[list(design.linear[o])]
        np.testing.assert_allclose(found, y, rtol=1e-7, atol=1e-9 * max(1.0, float(np.max(np.abs(y)))))
    # two points along a line in the linear parameters: the run follows
    step = np.zeros_like(theta)
    step[list(model.linear)] = 1e-3 * rng.standard_normal(len(model.linear))
    ends = {f: model.simulate(view, theta + f * step) for f in (0, 1, 2, 4)}
    for o in run:
        scale = float(np.max(np.abs(ends[0][o]))) + 1e-12
        if model.chain.curved:
            short, long = (ends[2 * k][o] - 2 * ends[k][o] + ends[0][o] for k in (1, 2))
            assert 0.1 < np.linalg.norm(short) / np.linalg.norm(long) < 0.4
            assert np.max(np.abs(short)) < 1e-2 * np.max(np.abs(ends[1][o] - ends[0][o]))
            continue
        np.testing.assert_allclose(ends[2][o] - ends[1][o], ends[1][o] - ends[0][o], atol=1e-8 * scale, rtol=1e-6)


@pytest.mark.parametrize(("make_one", "names"), CASES, ids=["+".join(n) + "/" + m.__name__ for m, n in CASES])
def test_text_round_trip(make_one: object, names: tuple[str, ...]) -> None:
    assert callable(make_one)
    rec = make_one()
    model = Model(make(rec), [place(rec, n) for n in names])
    theta = model.start(rec)
    text = describe(model, theta)
    again, other = restore(replace(rec, twin=TwinText(text["kind"], text["parameters"], tuple(text["effects"]))))
    view = View.whole(rec, 20)
    for o, y in model.simulate(view, theta).items():
        np.testing.assert_allclose(again.simulate(view, other)[o], y, rtol=1e-6, atol=1e-9)


def test_a_force_remembers_the_fastest_mode_of_the_twin_that_it_is_fitted_in() -> None:
    """Its steps follow that rate wherever it is read again (``test_apply.py``)."""
    assert place(oscillator(), "cubic_stiffness").settings[FASTEST] == pytest.approx((30.0,))
    assert FASTEST not in place(piezo(), "backlash").settings


def test_what_is_linear() -> None:
    rec = piezo()
    lag = Model(make(rec), [place(rec, "hysteresis"), place(rec, "first_order_lag")])
    assert [p.name for p in lag.parameters if not p.linear] == ["first_order_lag[command].time_constant_s"]
    steps = Model(make(rec), [place(rec, "hysteresis"), place(rec, "quantization")])
    assert steps.linear == ()
    axle = axis()
    friction = Model(make(axle), [place(axle, "coulomb_friction")])
    assert friction.linear == ()
    assert [p.name for p in Model(make(axle)).parameters if p.linear] == ["inverse_mass", "offset_per_mass"]


def test_a_held_out_block_does_not_see_its_output() -> None:
    """On a free-running axis only the first samples of a block set its state; later ones change nothing."""
    rec = axis()
    integrating = replace(rec, twin=TwinText("mechanical_axis", {"mass": 2.0, "damping": 1.0}))
    model = Model(make(integrating))
    view = View(integrating, ((600, 1000),), 30)
    first = model.simulate(view, model.start(integrating))["position"]
    bent = rec.outputs["position"].copy()
    bent[630:] += 1.0
    other = replace(integrating, outputs={"position": bent})
    second = model.simulate(View(other, ((600, 1000),), 30), model.start(integrating))["position"]
    np.testing.assert_array_equal(first, second)
    assert not view.scored(model.twin)[:30].any()


def test_samples_behind_every_start_are_not_scored() -> None:
    """A segment within a range is scored from ``init`` samples on, and one in another range changes nothing."""
    rec = replace(axis(), segments=(300, 790, 900))
    twin = make(rec)
    view = View(rec, ((100, 400), (780, 800), (905, 950)), 30)
    at = view.index
    behind = [(at >= s) & (at < s + 30) for s in (0, *rec.segments)]
    begins = np.repeat([100, 780, 905] if twin.restart else [0, 0, 0], [300, 20, 45])
    expected = ~np.any(behind, axis=0) & (at >= begins + 30)
    np.testing.assert_array_equal(view.scored(twin), expected)
    assert expected.any()
    assert not expected.all()


def test_memory_of_a_block_comes_from_earlier_inputs() -> None:
    rec = piezo()
    model = Model(make(rec), [place(rec, "backlash")])
    theta = model.start(rec)
    theta[-1] = 0.05
    whole = model.simulate(View.whole(rec), theta)["displacement"]
    part = model.simulate(View(rec, ((500, 800),)), theta)["displacement"]
    np.testing.assert_array_equal(part, whole[500:800])


def test_sites_and_reasons() -> None:
    rec = piezo()
    twin = make(rec)
    assert [p.note for p in sites(twin, rec, EFFECTS["hysteresis"])] == ["input or output"]
    assert sites(twin, rec, EFFECTS["coulomb_friction"]) == []
    assert "equation of motion" in why_not(twin, rec, EFFECTS["coulomb_friction"])
    assert "supply" in why_not(twin, rec, EFFECTS["supply_sensitivity"])
    assert "dead_time" in why_not(twin, rec, EFFECTS["channel_delay"])
    body = accelerometer()
    delays = sites(make(body), body, EFFECTS["channel_delay"])
    # both forms of a delay, each once per output
    assert [p.target for p in delays] == 2 * ["voltage_x", "voltage_y", "voltage_z"]
    kinds = {p.site for p in sites(make(oscillator()), oscillator(), EFFECTS["hysteresis"])}
    assert kinds == {"input", "output", "feedback"}
    # what an actuator alone has is in front of a plant that moves
    actuated = sites(make(oscillator()), oscillator(), EFFECTS["rate_dependent_hysteresis"])
    assert {p.site for p in actuated} == {"input"}
    assert {p.site for p in sites(twin, rec, EFFECTS["rate_dependent_hysteresis"])} == {"output"}


def test_bursts_are_excused() -> None:
    rec = piezo()
    y = rec.outputs["displacement"].copy()
    for at in (200, 500, 640, 1000):
        y[at : at + 4] += 2.0
    rec = replace(rec, outputs={"displacement": y})
    base = Model(make(rec))
    theta = base.start(rec)
    theta[:2] = 0.4, 0.13
    spikes = prepare(base, View.whole(rec), theta, sites(base.twin, rec, EFFECTS["spikes"])[0])
    found = Model(base.twin, [spikes]).excused(View.whole(rec), "displacement")
    assert found[[201, 502, 641, 1002]].all()
    assert found.sum() < 60


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"name": "magic"}, "'magic' is not in the vocabulary"),
        ({"name": "creep", "site": "feedback", "target": "displacement"}, "cannot sit at 'feedback'"),
        ({"name": "creep", "target": "nowhere"}, "outputs .* are not among displacement"),
        ({"name": "backlash", "target": "displacement"}, "half_gap, missing_slope missing"),
        (
            {
                "name": "backlash",
                "target": "displacement",
                "parameters": {"half_gap": 0.1, "missing_slope": 1.0, "first_in_gap": "left"},
            },
            "parameters first_in_gap missing or not finite",
        ),
    ],
)
def test_bad_corrected_twins(entry: dict[str, object], message: str) -> None:
    rec = piezo()
    with pytest.raises(RecordingError, match=message):
        restore(replace(rec, twin=TwinText("piezo_stack", {}, (entry,))))


@pytest.mark.parametrize("base_kind", ["axis", "first_order", "friction"])
def test_what_a_view_remembers_never_outlives_a_change_of_base_parameters(base_kind: str) -> None:
    if base_kind == "first_order":
        u = wave()
        given = {"A": [[-5.0]], "B": [[5.0]], "C": [[1.0]]}
        rec = recording("state_space", DT, {"u": u}, {"y": 0.3 * u}, {"u": "V", "y": "V"}, given)
    else:
        rec = axis()
    twin = make(rec)
    output = twin.outputs[0]
    clip = {o.name: o for o in EFFECTS.values()}["saturation"]
    placed = [Placed(clip, "output", output, "sensor", (output,))]
    if base_kind == "friction":
        placed.append(sites(twin, rec, EFFECTS["coulomb_friction"])[0])
    model = Model(twin, placed)
    view = View.whole(rec)
    theta = model.start(rec)
    for j in range(model.n_base):
        changed = theta.copy()
        changed[j] = 1.5 * theta[j] + model.parameters[j].scale
        for t in (theta, changed):
            kept = model.simulate(view, t)[output]
            np.testing.assert_array_equal(kept, model.simulate(View.whole(rec), t)[output])
            design = model.design(view, t)
            np.testing.assert_array_equal(design.constant[output], model.design(View.whole(rec), t).constant[output])


def test_two_shapes_of_one_effect_with_the_same_numbers_are_not_taken_for_one_another() -> None:
    rec = piezo()
    twin, view = make(rec), View.whole(rec)
    shapes = [e for e in (EFFECTS["slew_limit"], *EFFECTS["slew_limit"].variants) if len(e.parts({}).nonlinear) == 2]
    assert len(shapes) == 2
    found: list[Array] = []
    for effect in shapes:
        model = Model(twin, [Placed(effect, "input", "command", "amplifier", ("displacement",))])
        theta = model.start(rec)
        theta[model.slices(0)[0]] = [300.0, 0.02]
        found.append(model.simulate(view, theta)["displacement"])
        np.testing.assert_array_equal(found[-1], model.simulate(View.whole(rec), theta)["displacement"])
    assert np.max(np.abs(found[0] - found[1])) > 1e-3


def test_a_file_without_the_begin_in_the_gap_begins_in_its_middle() -> None:
    """Corrected twins of earlier versions lack it; a parameter without influence may be left out, others may not."""
    rec = piezo()
    entry = {"name": "backlash", "target": "displacement", "settings": {"span": [40.0], "rest": [60.0]}}
    sized = {"half_gap": 3.0, "missing_slope": 0.1}
    courses: list[Array] = []
    for more in ({}, {"first_in_gap": 0.0}, {"first_in_gap": 1.0}):
        model, theta = restore(replace(rec, twin=TwinText("piezo_stack", {}, ({**entry, "parameters": sized | more},))))
        courses.append(model.simulate(View.whole(rec), theta)["displacement"])
    np.testing.assert_array_equal(courses[0], courses[1])
    assert np.max(np.abs(courses[0] - courses[2])) > 0.1
