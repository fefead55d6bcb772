"""What a report of the engine on one score has beside the names: holds, what is withheld, true p-values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_engine.cases import among, recording, wave
from tests.unit.mismatch_engine.test_hold_and_one_way import axis
from tools.mismatch.engine import pose as preparation
from tools.mismatch.engine.evidence import Doubt
from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.intervals import rounding_left
from tools.mismatch.engine.pose import Ended, Posed, prepared
from tools.mismatch.engine.report import Hold, Report
from tools.mismatch.engine.residual import residuals
from tools.mismatch.engine.screen import places
from tools.mismatch.engine.trial import Effort, extended
from tools.mismatch.engine.vary import size
from tools.mismatch.infer import borne_out as infer_borne_out
from tools.mismatch.infer import diagnose
from tools.mismatch.infer import run as infer_run
from tools.mismatch.infer.borne_out import borne_out
from tools.mismatch.infer.constants import START
from tools.mismatch.infer.decide import decide
from tools.mismatch.infer.density import gain_of_events
from tools.mismatch.infer.run import infer, report_of
from tools.mismatch.infer.store import outputs_at_odds
from tools.mismatch.recording import Recording

N = 2500


def stack(change: np.ndarray, u: np.ndarray) -> Recording:
    y = 0.12 * u + change + 0.01 * np.random.default_rng(5).standard_normal(u.size)
    return recording("piezo_stack", {"command": u}, {"displacement": y}, {"gain_um_per_V": 0.12, "offset_um": 0.0})


def test_a_named_delay_of_half_a_sample_is_the_hold(monkeypatch: pytest.MonkeyPatch) -> None:
    """Held inputs through a twin that runs them straight, on data that are made not to tell which of the two it is."""
    assumed = {"force": Hold("linear", "assumed")}
    monkeypatch.setattr(preparation, "infer_holds", lambda problem, base: assumed)
    report = diagnose(axis(5, zero=True), jobs=1, effects=[EFFECTS["dead_time"]])
    assert {h.how for h in report.hold.values()} == {"instead_of_delay"}
    assert not report.physics
    late = diagnose(axis(5, zero=False, late=3.0), jobs=1, effects=[EFFECTS["dead_time"]])
    assert [p.name for p in late.physics] == ["dead_time"]
    assert {h.how for h in late.hold.values()} == {"assumed"}


def test_an_effect_whose_size_may_be_zero_is_withheld(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(infer_borne_out, "broken", lambda *_: "")  # a fit to noise may be worse than no fit
    u = 40.0 * wave(np.random.default_rng(3), N)
    store = infer(stack(np.zeros(N), u), START, jobs=1, effects=[EFFECTS["first_order_lag"]]).found.store
    lag = store.with_one(store.base, places(store.problem, [EFFECTS["first_order_lag"]], ())[0])
    left, withheld = borne_out(store, among(lag, store.base))
    assert left == [store.base]
    assert [(w.name, w.output) for w in withheld] == [("first_order_lag", "displacement")]


def test_an_effect_that_the_data_show_is_not_withheld() -> None:
    u = 40.0 * wave(np.random.default_rng(4), N)
    change = 0.12 * (np.clip(u, -22.0, 25.0) - u)
    store = infer(stack(change, u), START, jobs=1, effects=[EFFECTS["saturation"]]).found.store
    best = store.ranked()[0]
    assert best.names == {"saturation"}
    assert borne_out(store, among(best, store.base)) == ([best, store.base], ())


def test_an_effect_that_the_whole_run_does_not_bear_out_is_withheld(monkeypatch: pytest.MonkeyPatch) -> None:
    """The decision is made on short stretches where a twin accumulates; the report is about the whole run."""
    u = 40.0 * wave(np.random.default_rng(4), N)
    inferred = infer(stack(0.12 * (np.clip(u, -22.0, 25.0) - u), u), START, jobs=1, effects=[EFFECTS["saturation"]])
    answer = decide(inferred.found.store, inferred.found.first)
    assert [p.name for p in report_of(inferred, answer, 0.3, 1).physics] == ["saturation"]

    def through(posed: Posed, base: Fit, fitted: Fit, held_out: float) -> Ended:
        return Ended(base, replace(fitted))

    doubts = [[Doubt(0, "holds_zero", ("limit_high",))], []]
    monkeypatch.setattr(infer_run, "run_through", through)
    monkeypatch.setattr(infer_run, "doubts_of", lambda *_: doubts.pop(0))
    report = report_of(inferred, answer, 0.3, 1)
    assert (report.verdict, report.physics) == ("unexplained", ())
    assert [(w.name, w.reason) for w in report.withheld] == [("saturation", "holds_zero")]


def test_outputs_that_are_down_to_the_noise_do_not_thin_the_evidence_of_another() -> None:
    assert outputs_at_odds([3.0, 3.0, 3.0]) == pytest.approx(3.0)
    assert outputs_at_odds([30.0, 0.0, 0.0, 0.3]) == pytest.approx(1.02, abs=0.01)
    assert outputs_at_odds([0.0, 0.0]) == 2.0


def test_one_clipped_channel_of_three_is_named() -> None:
    """Two channels are as simulated; a tenth of the third is clipped."""
    rng = np.random.default_rng(8)
    names = ("x", "y", "z")
    inputs = {f"specific_force_{a}": 5.0 * wave(rng, N) for a in names}
    outputs = {f"voltage_{a}": 0.3 * inputs[f"specific_force_{a}"] + 0.01 * rng.standard_normal(N) for a in names}
    clean = outputs["voltage_x"].copy()
    outputs["voltage_x"] = np.minimum(clean, np.quantile(clean, 0.9)) + 0.01 * rng.standard_normal(N)
    believed: dict[str, object] = {"scale_V_per_g": [0.3, 0.3, 0.3], "bias_V": [0.0, 0.0, 0.0]}
    r = recording("accelerometer", inputs, outputs, believed)
    report = diagnose(r, jobs=1, constants=START, effects=[EFFECTS["saturation"], EFFECTS["first_order_lag"]])
    assert [p.name for p in report.physics] == ["saturation"]


def three_axes(changes: dict[str, np.ndarray], rms: float = 1e-3) -> Recording:
    """A triad of accelerometers with white noise, and ``changes`` on top of its readings."""
    rng = np.random.default_rng(11)
    force = {f"specific_force_{a}": wave(np.random.default_rng(k), N) for k, a in enumerate("xyz")}
    volts = {
        f"voltage_{a}": 2.5 + 0.66 * force[f"specific_force_{a}"] + rms * rng.standard_normal(N)
        + changes.get(f"voltage_{a}", 0.0)
        for a in "xyz"
    }  # fmt: skip
    given: dict[str, object] = {"bias_V": [2.5] * 3, "scale_V_per_g": [0.66] * 3}
    return recording("accelerometer", force, volts, given)


def test_parameters_of_one_output_of_three_count_as_their_share_of_the_mean() -> None:
    t = np.arange(N) / 100.0
    hum = {f"voltage_{a}": 0.05 * np.sin(2 * np.pi * 31.7 * t + k) for k, a in enumerate("xyz")}
    store = infer(three_axes(hum), START, jobs=1, effects=[EFFECTS["vibration"]]).found.store
    assert store.outputs == pytest.approx(3.0, abs=0.1)
    one = next(s for s in store.sets.values() if len(s.placed) == 1)
    assert one.parameters == pytest.approx(size(one.placed[0]) / store.outputs)


def test_an_output_that_no_effect_touches_may_have_noise_of_any_colour() -> None:
    slow = lfilter([1.0], [1.0, -0.8], np.random.default_rng(3).standard_normal(N))
    made = three_axes({"voltage_x": 0.004 * slow})
    y = made.outputs["voltage_y"]
    made = replace(made, outputs={**made.outputs, "voltage_y": np.clip(y, 2.1, 2.95)})
    report = diagnose(made, jobs=1, effects=[EFFECTS["saturation"]])
    assert [(p.name, p.output) for p in report.physics] == [("saturation", "voltage_y")]
    assert report.verdict == "missing_physics"


@pytest.mark.parametrize("rms", [0.05, 0.15, 0.4])
def test_a_quantiser_leaves_what_noise_in_front_of_it_decides(rms: float) -> None:
    u = 40.0 * wave(np.random.default_rng(3), 20 * N)
    rng = np.random.default_rng(9)
    y = np.round(0.12 * u + rms * rng.standard_normal(20 * N))
    made = recording("piezo_stack", {"command": u}, {"displacement": y}, {"gain_um_per_V": 0.12, "offset_um": 0.0})
    problem, _, base = prepared(made, 0.3, 0, False)
    (place, *_) = places(problem, [EFFECTS["quantization"]], ())
    model, theta = extended(problem, base, replace(place, settings={"step": (1.0,), "origin": (0.0,)}))
    theta[:2] = 0.0, 0.12
    theta[model.slices(0)[0]] = rms
    fitted = replace(base, model=model, theta=theta, residual=residuals(problem, model, theta))
    left = float(np.std(fitted.residual["displacement"][problem.held_rows]))
    assert rounding_left(problem, fitted, "displacement") == pytest.approx(left, rel=0.1)
    assert rounding_left(problem, base, "displacement") == 0.0


def test_refinement_is_for_candidates_that_could_be_extended() -> None:
    effort = Effort(share=0.5, least=0.05)
    assert effort.most_left(0.99) == pytest.approx(0.1)
    assert effort.most_left(0.0) == pytest.approx(0.95)
    assert effort.most_left(1.0) > 0.0


def test_events_within_their_own_size_are_told_from_heavy_tails() -> None:
    rng = np.random.default_rng(9)
    quiet, heavy = rng.standard_normal(2700), rng.standard_t(3.0, 2700)
    at = np.zeros(2700, np.bool_)
    at[rng.choice(2700, 14, replace=False)] = True
    burst = np.where(at, rng.choice([-1.0, 1.0], 2700) * rng.uniform(10.0, 30.0, 2700), quiet)
    assert gain_of_events(burst, at, 2000.0, 0.05) > START.per_name
    assert gain_of_events(heavy, np.abs(heavy) > 6.0, 2000.0, 0.05) < 0.0
    # a burst is marked with the samples beside its peak, which may be noise
    wide = np.convolve(at, np.ones(3), "same") > 0
    assert gain_of_events(burst, wide, 2000.0, 0.05) > START.per_name


def test_the_chance_of_a_name_counts_every_candidate() -> None:
    u = 40.0 * wave(np.random.default_rng(4), N)
    change = 0.12 * (np.minimum(u, np.quantile(u, 0.95)) - u)
    report, alone = (
        diagnose(stack(change, u), jobs=1, constants=START, effects=of)
        for of in ([EFFECTS[n] for n in ("saturation", "first_order_lag", "dead_zone")], [EFFECTS["saturation"]])
    )
    assert [p.name for p in report.physics] == [p.name for p in alone.physics] == ["saturation"]
    assert report.checks.false_alarm_p_value > alone.checks.false_alarm_p_value


def test_the_smallest_effect_that_would_have_been_named_is_true() -> None:
    """A response to temperature of twice the stated limit is named, of half of it is not."""
    rng = np.random.default_rng(12)
    u = 40.0 * wave(rng, N)
    warm = 20.0 + 3.0 * wave(rng, N, low=0.1, high=1.0)
    few = [EFFECTS["temperature_sensitivity"], EFFECTS["saturation"]]

    def report(rms: float) -> Report:
        course = (warm - warm.mean()) / warm.std()
        r = replace(stack(rms * course, u), context={"temperature": warm})
        return diagnose(r, jobs=1, effects=few)

    limit = report(0.0).detection_limit["displacement"]["temperature_sensitivity"]
    assert limit is not None
    assert not report(0.5 * limit).physics
    assert [p.name for p in report(2.0 * limit).physics] == ["temperature_sensitivity"]
