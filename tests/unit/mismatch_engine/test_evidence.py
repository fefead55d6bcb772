"""No name without evidence: recordings integrated here, an effect that is not in them, and what the report may say."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from sim_devices.physics.catalogue import EFFECTS
from sim_devices.physics.effect import Context
from sim_devices.physics.hysteresis import CURVES, FORMS
from tests.unit.mismatch_engine.cases import RATE, among, named, recording, wave
from tools.mismatch.engine.evidence import Doubt, absent_groups, doubt_of, holds_zero
from tools.mismatch.engine.found import human_values
from tools.mismatch.engine.intervals import uncertainty
from tools.mismatch.engine.pose import Ended, prepared
from tools.mismatch.engine.report import ParameterValue, Report, Withheld
from tools.mismatch.engine.screen import places
from tools.mismatch.infer import decide, diagnose
from tools.mismatch.infer.borne_out import borne_out as borne_out_of
from tools.mismatch.infer.constants import learned
from tools.mismatch.infer.run import is_no_better
from tools.mismatch.infer.store import Store
from tools.mismatch.recording import Recording


def stage(seed: int, *, coulomb: float = 0.0, late_samples: float = 0.0) -> Recording:
    """A sprung stage in semi-implicit Euler steps, thirty to a sample; ``coulomb`` N of friction, force ``late``."""
    rng = np.random.default_rng(seed)
    n, sub = 3000, 30
    force = 3.0 * wave(rng, n, low=0.3, high=6.0)
    fine = np.interp((np.arange(n * sub) / sub) - late_samples, np.arange(n), force)
    h, x, v = 1 / (RATE * sub), 0.0, 0.0
    position = np.empty(n)
    for i in range(n):
        position[i] = x
        for f in fine[i * sub : (i + 1) * sub]:
            push = f - 4.0 * v - 900.0 * x
            if coulomb > 0.0:
                push = push - coulomb * np.sign(v) if v else push - np.clip(push, -coulomb, coulomb)
            new = v + h * push / 0.5
            v, x = (0.0 if coulomb and new * v < 0 else new), x + h * new
    measured = position + rng.normal(0, 2e-6, n)
    believed: dict[str, object] = {"mass": 0.5, "damping": 4.0, "stiffness": 900.0, "offset_force": 0.0}
    return recording("mechanical_axis", {"force": force}, {"position": measured}, believed)


def weighed(made: Recording, name: str) -> tuple[frozenset[str], tuple[Withheld, ...], Store]:
    """Return the names, the withheld effects and the sets of a search that took one effect."""
    problem, _, base = prepared(made, 0.3, 0, False)
    store = Store(problem, base, learned())
    with np.errstate(all="ignore"):
        one = store.with_one(store.base, places(problem, [EFFECTS[name]], ())[0])
        sets, withheld = borne_out_of(store, among(one, store.base))
    return sets[0].names, withheld, store


def borne_out(report: Report) -> None:
    """Every name on the page has a size that is not zero and did not end at a limit that matters."""
    for p in report.physics:
        effect = EFFECTS[p.name]
        assert not any(b.endswith(f".{n}") for b in p.at_bound for n in effect.essential)
        assert any(not holds_zero(v) for v in p.parameters.values())
    for group in report.equivalent:
        named = [p for p in report.physics if p.name == group.names[0]]
        assert all(p.confidence < 1.0 for p in named)


@pytest.mark.parametrize("name", ["backlash", "dead_time", "first_order_lag", "coulomb_friction"])
def test_an_effect_that_is_not_there_is_not_named_though_a_search_took_it(name: str) -> None:
    names, withheld, _ = weighed(stage(3), name)
    assert not names
    assert [w.name for w in withheld] == [name]
    assert withheld[0].reason in ("holds_zero", "at_limit")
    assert withheld[0].shown_by


def test_a_set_pays_for_the_choice_of_its_places() -> None:
    """A dead zone at the input or at the output of one axis has two places, friction in several forms has one."""
    problem, _, base = prepared(stage(3), 0.3, 0, False)
    effects = [EFFECTS["dead_zone"], EFFECTS["coulomb_friction"]]
    store = Store(problem, base, learned(), effects)
    with np.errstate(all="ignore"):
        sets = [store.with_one(store.base, places(problem, [e], ())[0]) for e in effects]
    assert [s.choices for s in sets] == pytest.approx([math.log(2.0), 0.0])


def test_friction_that_is_there_stays() -> None:
    names, withheld, _ = weighed(stage(4, coulomb=0.3), "coulomb_friction")
    assert names == {"coulomb_friction"}
    assert withheld == ()


def test_a_case_of_an_effect_does_not_stand_beside_it() -> None:
    """Stribeck friction has Coulomb's in it; a loop at another place is another loop."""
    problem, _, base = prepared(stage(3), 0.3, 0, False)
    store = Store(problem, base, learned())
    friction = [EFFECTS[n] for n in ("coulomb_friction", "stribeck_friction")]
    for name, other in (("coulomb_friction", "stribeck_friction"), ("stribeck_friction", "coulomb_friction")):
        present = [p for p in places(problem, friction, ()) if p.effect.name == name][:1]
        assert other in {p.effect.name for p in places(problem, friction, ())}
        assert not places(problem, friction, (*store.base.placed, *present))
    loops = [EFFECTS[n] for n in ("hysteresis", "backlash")]
    free = places(problem, loops, ())
    loop = next(p for p in free if p.effect.name == "hysteresis" and p.site == "output")
    beside = {(p.effect.name, p.site) for p in places(problem, loops, (loop,))}
    assert ("backlash", "output") not in beside
    assert ("backlash", "input") in beside


@pytest.mark.parametrize(
    ("seed", "coulomb"),
    [
        (0, 0.0),
        *(pytest.param(s, c, marks=pytest.mark.slow) for s, c in ((1, 0.0), (2, 0.0), (1, 0.2), (2, 0.2))),
    ],
)
def test_every_name_of_a_whole_diagnosis_is_borne_out(seed: int, coulomb: float) -> None:
    report = diagnose(stage(20 + seed, coulomb=coulomb), jobs=1)
    borne_out(report)
    assert [p.name for p in report.physics] == (["coulomb_friction"] if coulomb else [])


def test_which_groups_of_parameters_may_be_zero() -> None:
    def value(v: float, half: float) -> ParameterValue:
        return ParameterValue(v, "1", (v - half, v + half))

    play, share = EFFECTS["backlash"], value(1.0, 0.1)
    assert absent_groups(play.vanishes_with, {"gap": value(7e-5, 3.6e-4), "slope_lost_inside": share}) == [("gap",)]
    assert absent_groups(play.vanishes_with, {"gap": value(1.0, 0.1), "slope_lost_inside": share}) == []
    # any amplitude of a line will do
    lines = EFFECTS["vibration"]
    assert absent_groups(lines.vanishes_with, {"amplitude_1": value(1.0, 0.1), "amplitude_2": value(0.0, 0.1)}) == []
    # an interval that nobody could work out excludes nothing
    assert holds_zero(ParameterValue(1.0, "1", (float("nan"), float("nan"))))
    assert not holds_zero(ParameterValue(4.0, "1", (4.0, 4.0)))


def test_of_several_sizes_one_may_be_away_from_zero_by_chance() -> None:
    barely = ParameterValue(2.0, "1", (0.1, 3.9))  # 2.06 standard errors
    assert not holds_zero(barely)
    assert holds_zero(barely, 2)  # 2.24 are needed of two
    clear = ParameterValue(2.0, "1", (0.5, 3.5))
    assert not holds_zero(clear, 3)
    spring = EFFECTS["cubic_stiffness"]
    nothing = ParameterValue(0.0, "1", (-1.0, 1.0))
    assert absent_groups(spring.vanishes_with, {"cubic_stiffness": nothing, "quadratic_stiffness": barely})
    assert not absent_groups(spring.vanishes_with, {"cubic_stiffness": nothing, "quadratic_stiffness": clear})


def narrow_play(loss: float) -> Recording:
    """A stack that loses ``loss`` of its response inside a play of 0.1 V, at 0.2 um/V and 3 nm of noise."""
    rng = np.random.default_rng(5)
    volts = 50.0 + 40.0 * wave(rng, 4000, low=3.0, high=20.0)  # a sample moves further than the play is wide
    inside, p = np.empty(volts.size), float(volts[0])
    for i, v in enumerate(volts.tolist()):
        p = max(v - 0.05, min(v + 0.05, p))
        inside[i] = v - p
    um = 1.0 + 0.2 * (volts - loss * inside) + rng.normal(0, 0.003, volts.size)
    return recording("piezo_stack", {"command": volts}, {"displacement": um}, {"gain_um_per_V": 0.2, "offset_um": 1.0})


def test_of_a_narrow_play_only_the_width_times_the_slope_is_certain() -> None:
    names, _, store = weighed(narrow_play(0.06), "backlash")
    assert names == {"backlash"}
    fitted = next(s.fitted for s in store.sets.values() if s.placed)
    unsure = uncertainty(store.problem, fitted)
    values = human_values(store.problem, fitted, unsure)["backlash[displacement]"]
    assert absent_groups(EFFECTS["backlash"].vanishes_with, values)
    # width times slope: 0.1 V times 0.06, known to a tenth
    area = values["gap"].value * values["slope_lost_inside"].value
    assert area == pytest.approx(0.006, rel=0.3)
    names, withheld, _ = weighed(narrow_play(0.0), "backlash")
    assert not names
    assert [w.reason for w in withheld] == ["holds_zero"]


def test_a_loop_whose_change_with_speed_may_be_zero_is_a_plain_loop() -> None:
    _, withheld, store = weighed(slow_loop(), "rate_dependent_hysteresis")
    assert [w.name for w in withheld] == ["rate_dependent_hysteresis"]
    assert named(slow_loop(), ("rate_dependent_hysteresis", "hysteresis")) == {"hysteresis"}
    fitted = next(s.fitted for s in store.sets.values() if s.placed)
    doubt = doubt_of(fitted, 0, RATE_FREE, uncertainty(store.problem, fitted))
    assert doubt is not None
    assert doubt.shown_by == ("change_with_speed",)


def slow_loop() -> Recording:
    """Triangles of one speed through a Bouc-Wen loop, Euler steps."""
    rng = np.random.default_rng(7)
    t = np.arange(6000) / RATE
    u = 50 + 40 * (2 * np.abs(2 * ((0.5 * t) % 1.0) - 1) - 1)
    z = np.zeros(t.size)
    for i in range(1, t.size):
        d = (u[i] - u[i - 1]) / 16.0
        z[i] = z[i - 1] + d - 0.5 * abs(d) * z[i - 1] - 0.5 * d * abs(z[i - 1])
    y = 1.0 + 0.12 * u + 0.4 * z + rng.normal(0, 0.02, t.size)
    return recording("piezo_stack", {"command": u}, {"displacement": y}, {"gain_um_per_V": 0.12, "offset_um": 1.0})


RATE_FREE = {
    "loop_width_share_slow": ParameterValue(0.1, "1", (0.09, 0.11)),
    "loop_width_share_fast": ParameterValue(0.11, "1", (0.1, 0.12)),
    "change_with_speed": ParameterValue(0.1, "1", (-5.6, 5.7)),
}


def test_a_record_of_one_speed_does_not_say_that_a_loop_changes_with_speed() -> None:
    report = diagnose(slow_loop(), jobs=1)
    borne_out(report)
    for p in report.physics:
        if p.name == "rate_dependent_hysteresis":
            assert not holds_zero(p.parameters["change_with_speed"])


LAG_ALONE = {**RATE_FREE, "loop_width_share_slow": ParameterValue(0.1, "1", (-0.03, 0.23))}
LAG_ALONE["change_with_speed"] = ParameterValue(0.6, "1", (0.4, 0.8))
NEVER_MET = {
    "rate_up": ParameterValue(931.0, "V/s", (374.0, 1487.0)),
    "share_of_fastest_input": ParameterValue(0.9, "1", (0.4, 1.6)),
}


def test_a_loop_that_may_close_at_rest_is_that_of_a_lag() -> None:
    _, _, store = weighed(slow_loop(), "rate_dependent_hysteresis")
    fitted = next(s.fitted for s in store.sets.values() if s.placed)
    doubt = doubt_of(fitted, 0, LAG_ALONE, uncertainty(store.problem, fitted))
    assert doubt is not None
    assert doubt.shown_by == ("loop_width_share_slow",)
    laws = {s.placed[0].effect.name: s.laws for s in store.sets.values() if s.placed}
    assert laws["rate_dependent_hysteresis"] == 2


def test_a_limit_that_may_never_be_met_is_no_more_than_a_lag() -> None:
    _, _, store = weighed(slow_loop(), "slew_limit")
    fitted = next(s.fitted for s in store.sets.values() if s.placed)
    unsure = uncertainty(store.problem, fitted)
    assert doubt_of(fitted, 0, NEVER_MET, unsure) == Doubt(0, "holds_plain", ("share_of_fastest_input",))
    met = {**NEVER_MET, "share_of_fastest_input": ParameterValue(0.5, "1", (0.4, 0.6))}
    assert doubt_of(fitted, 0, met, unsure) is None


@pytest.mark.parametrize(("explained", "whole"), [(50.0, True), (5.0, False)])
def test_noise_that_would_be_louder_than_what_was_found_is_a_doubt(
    monkeypatch: pytest.MonkeyPatch, explained: float, whole: bool
) -> None:
    """Ten noise variances are left, and none of them if the noise is as loud as it can be."""
    _, _, store = weighed(slow_loop(), "hysteresis")
    left = {False: (10.0, explained), True: (0.0, explained)}
    monkeypatch.setattr(decide, "worst_left", lambda *_, doubt: left[doubt])
    named = next(s for s in store.sets.values() if s.placed)
    assert decide.judge(store, named, None).whole is whole
    assert not decide.judge(store, store.base, None).whole


def test_an_effect_without_which_the_whole_run_is_as_good_is_not_named() -> None:
    _, _, store = weighed(slow_loop(), "hysteresis")
    named = next(s.fitted for s in store.sets.values() if s.placed)
    base = store.base.fitted
    assert not is_no_better(store.problem, Ended(base, named))
    assert is_no_better(store.problem, Ended(replace(base, residual=named.residual), named))
    assert not is_no_better(store.problem, Ended(base, base))


def test_a_curve_that_trades_with_a_gain_is_sure_as_a_whole() -> None:
    """Two sines through a cubic: the gain and the weights of the curve are nearly collinear."""
    t = np.arange(900) * 0.01
    u = np.sin(2 * np.pi * 0.5 * t) + 0.4 * np.sin(2 * np.pi * 1.7 * t)
    y = 2.0 * u + 0.5 * u**3 + np.random.default_rng(1).normal(0, 0.01, t.size)
    made = recording("piezo_stack", {"command": u}, {"displacement": y}, {"gain_um_per_V": 2.0, "offset_um": 0.0})
    names, withheld, _ = weighed(made, "static_nonlinearity")
    assert names == {"static_nonlinearity"}
    assert not withheld


STACK: dict[str, object] = {"gain_um_per_V": 0.12, "offset_um": 0.0}


def moved_stack(change: np.ndarray, volts: np.ndarray, noise: float) -> Recording:
    """A stack whose displacement (n,) has a ``change`` and white noise beside its gain."""
    um = 0.12 * volts + change + np.random.default_rng(0).normal(0, noise, volts.size)
    return recording("piezo_stack", {"command": volts}, {"displacement": um}, STACK)


@pytest.mark.parametrize("seed", [1, 3, 12])
def test_a_zone_too_narrow_for_its_slope_is_still_one(seed: int) -> None:
    """Width times slope is certain; the slope alone was estimated at 1.2 to 1.7 of what can be lost."""
    volts = 50.0 * wave(np.random.default_rng(seed), 3000, low=0.3, high=6.0)
    made = moved_stack(-0.12 * np.clip(volts, -0.3, 0.3), volts, 0.03)
    names, withheld, store = weighed(made, "dead_zone")
    assert (names, withheld) == ({"dead_zone"}, ())
    (zone,) = (s for s in store.sets.values() if s.placed)
    lost = {h.name: h.value for h in zone.fitted.model.human(zone.fitted.theta)[zone.placed[0].label]}
    assert lost["slope_lost_inside"] > EFFECTS["dead_zone"].limits["slope_lost_inside"][1]
    assert zone.proper


@pytest.mark.parametrize("loop", [0.0, 0.02])
def test_a_curve_beside_stops_does_not_show_a_loop(loop: float) -> None:
    """The weights of stops and curve were jointly certain by the curve alone, and a curve was named hysteresis."""
    volts = 40.0 * wave(np.random.default_rng(0), 3000, low=0.3, high=6.0)
    behind, p = np.empty(volts.size), volts[0]
    for i, v in enumerate(volts):
        behind[i] = p = max(v - 10.0, min(v + 10.0, p))
    z = volts / 40.0
    made = moved_stack(0.06 * (np.exp(z) - 1.0 - z) + loop * 0.12 * (behind - volts), volts, 0.015)
    problem, _, base = prepared(made, 0.3, 0, False)
    place = places(problem, [EFFECTS["hysteresis"]], ())[0]
    form = float(FORMS.index("stops_curved"))

    def prepare(x: np.ndarray, residual: np.ndarray, ctx: Context) -> dict[str, tuple[float, ...]]:
        found = dict(EFFECTS["hysteresis"].prepare(x, residual, ctx))
        return {k: v for k, v in found.items() if k in ("range", "rest")} | {"form": (form,), "sign": (-1.0,)}

    bent = replace(place, effect=replace(place.effect, prepare=prepare))
    store = Store(problem, base, learned())
    with np.errstate(all="ignore"):
        one = store.with_one(store.base, bent)
        unsure = uncertainty(problem, one.fitted)
    weights = one.fitted.model.slices(0)[1]
    memory = unsure.chance_of_none(0, weights.stop - weights.start - one.placed[0].weights_beside)
    assert one.placed[0].weights_beside == CURVES
    assert (memory < 0.05) == (loop > 0.0)
