"""Two filters in a row with an effect between them, and the split of a linear twin that finds it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import butter, lfilter, lsim, zpk2ss, zpk2tf

from sim_devices.physics.catalogue import EFFECTS
from sim_devices.physics.diode import conducted
from tests.unit.mismatch_engine.cases import recording
from tools.errors import RecordingError
from tools.mismatch.engine.partition import Filter
from tools.mismatch.engine.pose import opened
from tools.mismatch.infer import diagnose
from tools.mismatch.recording import Recording
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_sites import sites, why_not
from tools.mismatch.simulate_text import describe, restore
from tools.mismatch.simulate_view import View
from tools.mismatch.twins.cascade import BETWEEN, CascadeTwin
from tools.mismatch.twins.make import make

FIRST = ([-0.9, 0.1], [0.75 + 0.35j, 0.75 - 0.35j, 0.5])
SECOND = ([0.3 + 0.9j, 0.3 - 0.9j], [0.8 + 0.2j, 0.8 - 0.2j, 0.6])
PRODUCT = (FIRST[0] + SECOND[0], FIRST[1] + SECOND[1])


def unit_gain(zeros: list[complex], poles: list[complex]) -> float:
    return float(np.real(np.prod([1 - p for p in poles]) / np.prod([1 - z for z in zeros])))


def matrices(zeros: list[complex], poles: list[complex], gain: float) -> dict[str, object]:
    return {k: m.real.tolist() for k, m in zip("ABCD", zpk2ss(zeros, poles, gain), strict=True)}


def filtered(u: np.ndarray, zeros: list[complex], poles: list[complex]) -> np.ndarray:
    """The response (n,) of a filter of unit gain at rest, from rest."""
    b, a = zpk2tf(zeros, poles, unit_gain(zeros, poles))
    return lfilter(np.concatenate([np.zeros(a.size - b.size), b.real]), a.real, u)


def circuit(n: int, knee: float) -> tuple[np.ndarray, np.ndarray]:
    """Input and output (n,) of two filters with a diode between them."""
    u = 0.6 * lfilter([0.5], [1.0, -0.5], np.random.default_rng(3).standard_normal(n))
    return u, filtered(conducted(filtered(u, *FIRST), knee, 0.05, 1.0), *SECOND)


def in_two(u: np.ndarray, y: np.ndarray) -> Recording:
    first, second = (matrices(*f, unit_gain(*f)) for f in (FIRST, SECOND))
    return recording("state_space", {"u": u}, {"y": y}, {**second, "discrete": True, "first": first})


def test_two_filters_are_the_same_twin_as_their_product() -> None:
    u, y = circuit(1500, 1e3)
    rec = in_two(u, y)
    twin = make(rec)
    assert isinstance(twin, CascadeTwin)
    one = recording("state_space", {"u": u}, {"y": y}, {**matrices(*PRODUCT, unit_gain(*PRODUCT)), "discrete": True})
    a, b = (Model(make(r)) for r in (rec, one))
    view = View.whole(rec)
    assert a.simulate(view, a.start(rec))["y"] == pytest.approx(b.simulate(view, b.start(one))["y"], abs=1e-6)


def test_a_diode_between_the_filters_is_simulated_and_written_down() -> None:
    u, y = circuit(1500, 0.4)
    rec = in_two(u, y)
    twin = make(rec)
    effect = EFFECTS["one_sided_conduction"]
    place = next(p for p in sites(twin, rec, effect) if p.target == BETWEEN)
    assert (place.site, place.stage) == ("input", "mechanics")
    model = Model(twin, [replace(place, settings={"range": (-2.0, 2.0), "side": (1.0,)})])
    theta = model.start(rec)
    theta[model.slices(0)[0]] = 0.4, 0.05
    whole = View.whole(rec)
    assert model.simulate(whole, theta)["y"] == pytest.approx(y, abs=1e-6)
    table = describe(model, theta)
    again = replace(rec, twin=replace(rec.twin, parameters=table["parameters"], effects=tuple(table["effects"])))
    other, values = restore(again)
    assert other.simulate(whole, values)["y"] == pytest.approx(y, abs=1e-6)


def test_a_diode_is_offered_between_filters_and_where_a_voltage_ends() -> None:
    u, y = circuit(400, 0.4)
    rec, diode = in_two(u, y), EFFECTS["one_sided_conduction"]
    volts = [("output", "y"), ("input", "u"), ("input", BETWEEN)]
    assert [(p.site, p.target) for p in sites(make(rec), rec, diode)] == volts
    one = recording("state_space", {"u": u}, {"y": y}, {**matrices(*SECOND, 1.0), "discrete": True})
    assert [(p.site, p.target) for p in sites(make(one), one, diode)] == volts[:2]
    pushed = replace(one, unit={"u": "N", "y": "mm"})
    assert sites(make(pushed), pushed, diode) == []
    assert "no signal in V" in why_not(make(pushed), pushed, diode)


def test_a_corrected_twin_has_no_places_that_its_core_lacks() -> None:
    """What only two filters have, and what helps a corrected twin with its parameters, once had one name."""
    u, y = circuit(400, 0.4)
    rec = recording("state_space", {"u": u}, {"y": y}, {**matrices(*SECOND, 1.0), "discrete": True})
    place = next(p for p in sites(make(rec), rec, EFFECTS["saturation"]) if p.site == "output")
    model = Model(make(rec), [replace(place, settings={"range": (-1.0, 1.0)})])
    table = describe(model, model.start(rec))
    again = replace(rec, twin=replace(rec.twin, parameters=table["parameters"], effects=tuple(table["effects"])))
    assert {p.target for p in sites(make(again), again, EFFECTS["dead_zone"])} == {"u", "y"}


def test_equations_have_no_place_between_filters() -> None:
    u, y = circuit(400, 0.4)
    table: dict[str, object] = {"states": {"level": "V"}, "equations": {"level": "(inflow - level) / lag"}, "lag": 0.1}
    rec = recording("ode", {"inflow": u}, {"level": y}, table)
    assert {p.target for p in sites(make(rec), rec, EFFECTS["saturation"])} == {"inflow", "level"}


def test_parameters_of_two_filters_are_reported_whatever_comes_behind_them() -> None:
    """Those of the second filter come first; the first filter's and the effects' are no business of its names."""
    rec = in_two(*circuit(400, 0.4))
    twin = make(rec)
    theta = twin.start(rec)
    names = [h.name for h in twin.human(theta)]
    assert "y0" in names
    assert len([n for n in names if n.startswith("first_")]) == 3
    assert [h.name for h in twin.human(np.concatenate([theta, [1.0, 2.0]]))] == names


def test_every_parameter_of_two_filters_moves_the_output() -> None:
    u, y = circuit(1500, 1e3)
    rec = in_two(u, y)
    model = Model(make(rec))
    theta = model.start(rec)
    plain = model.simulate(View.whole(rec), theta)["y"]
    for i, p in enumerate(model.parameters):
        moved = theta.copy()
        moved[i] += 0.01 * max(abs(theta[i]), 0.1)
        change = model.simulate(View.whole(rec), moved)["y"] - plain
        assert np.max(np.abs(change)) > 1e-5, p.name


def test_a_split_is_found_where_a_curve_sits_inside() -> None:
    u, y = circuit(12000, 0.4)
    noise = 1e-3 * np.random.default_rng(1).standard_normal(y.size)
    y = y + noise
    believed = {**matrices(*PRODUCT, unit_gain(*PRODUCT)), "discrete": True}
    rec = recording("state_space", {"u": u}, {"y": y}, believed)
    split = opened(rec, 0.3, 0)
    assert "first" in split.twin.parameters
    first = split.twin.parameters["first"]
    assert isinstance(first, dict)
    poles = np.linalg.eigvals(np.array(first["A"]))
    assert np.sort_complex(poles) == pytest.approx(np.sort_complex(np.array(FIRST[1])), abs=0.06)
    straight = recording("state_space", {"u": u}, {"y": filtered(u, *PRODUCT) + noise}, believed)
    assert opened(straight, 0.3, 0) is straight


def test_a_curve_at_the_output_splits_nothing() -> None:
    u, _ = circuit(12000, 1e3)
    y = conducted(filtered(u, *PRODUCT), 0.3, 0.05, 1.0)
    believed = {**matrices(*PRODUCT, unit_gain(*PRODUCT)), "discrete": True}
    rec = recording("state_space", {"u": u}, {"y": y}, believed)
    assert opened(rec, 0.3, 0) is rec


@pytest.mark.slow
def test_a_limit_in_front_of_a_fast_filter_is_no_split_and_no_dead_zone() -> None:
    """Rates of tens of thousands in rad/s, as in any circuit: a companion matrix in seconds overflows."""
    rate_hz, n, rng = 51200.0, 10_000, np.random.default_rng(11)
    u = 2 * lfilter(*butter(3, 0.12), rng.standard_normal(n))
    poles, gain = np.array([]), 1.0
    for corner_hz in (2000.0, 3500.0):
        _, more, k = butter(3, 2 * np.pi * corner_hz, analog=True, output="zpk")
        poles, gain = np.concatenate([poles, more]), gain * k
    unit = 2e4  # time in these for the truth, too
    a, b, c, d = (m.real for m in zpk2ss([], poles / unit, gain / unit**6))
    limited = np.clip(u, -1.2, 1.2)
    y = lsim((a, b, c, d), limited, unit / rate_hz * np.arange(n))[1]
    whole = Filter((), tuple(complex(p) for p in poles), gain)
    assert whole.run(limited, 1 / rate_hz, "linear") == pytest.approx(y, abs=1e-8)
    rec = recording(
        "state_space", {"u": u}, {"y": y + 2e-4 * rng.standard_normal(n)},
        {"A": (unit * a).tolist(), "B": (unit * b).tolist(), "C": c.tolist(), "D": d.tolist()}, rate_hz=rate_hz,
    )  # fmt: skip
    assert opened(rec) is rec
    tried = [EFFECTS[e] for e in ("saturation", "dead_zone", "static_nonlinearity", "resonance")]
    report = diagnose(rec, effects=tried)
    assert [(p.name, p.target) for p in report.physics] == [("saturation", "u")]
    assert report.physics[0].parameters["upper_limit"].value == pytest.approx(1.2, abs=1e-3)
    assert report.equivalent == ()


def test_a_filter_in_front_needs_one_input_and_one_output() -> None:
    u, y = circuit(400, 1e3)
    rec = in_two(u, y)
    with pytest.raises(RecordingError, match="one input and one output"):
        make(replace(rec, outputs={"y": y, "z": y}, unit={**rec.unit, "z": "V"}))
    with pytest.raises(RecordingError, match="first must be a table"):
        make(replace(rec, twin=replace(rec.twin, parameters={**rec.twin.parameters, "first": 3})))


def test_a_diode_meets_shockley_and_passes_the_other_side() -> None:
    x = np.linspace(-5.0, 5.0, 400)
    y = conducted(x, 0.5, 0.05, 1.0)
    current = x - y  # times the resistance
    assert current == pytest.approx(0.05 * np.exp((y - 0.5) / 0.05), abs=1e-9)
    assert y[x < -0.5] == pytest.approx(x[x < -0.5], abs=1e-9)
    assert conducted(x, 0.5, 0.05, -1.0) == pytest.approx(-conducted(-x, 0.5, 0.05, 1.0))
