"""Figures as people read them."""

import math
from dataclasses import replace

import pytest

from tests.unit.mismatch_report.canned import agrees, creep, missing_physics
from tools.mismatch.engine.report import ParameterValue, Withheld
from tools.mismatch.report import wording


@pytest.mark.parametrize(
    ("value", "ci", "shown"),
    [
        (0.021345, (0.0191, 0.0236), ("0.0213", "0.0191", "0.0236")),
        (1234.5678, (1234.0, 1235.1), ("1234.57", "1234.00", "1235.10")),
        (-3893.2, (-3963.0, -3822.0), ("-3893", "-3963", "-3822")),
        (2.53e-7, (2.4e-7, 2.6e-7), ("2.53e-07", "2.4e-07", "2.6e-07")),
        (729.4, (-1.1e7, 1.1e7), ("729", "-1.1e+07", "1.1e+07")),
        (0.99999999, (0.99999998, 1.0), ("1.00000", "1.00000", "1.00000")),
        (6.0, (6.0, 6.0), ("6", "6", "6")),
        (1.5, (-math.inf, math.inf), ("1.5", "-", "-")),
        (1.5, (math.nan, math.nan), ("1.5", "-", "-")),
        (0.0, (-0.01, 0.01), ("0.000", "-0.010", "0.010")),
    ],
)
def test_an_interval_sets_the_digits(value: float, ci: tuple[float, float], shown: tuple[str, str, str]):
    assert wording.interval(ParameterValue(value, "V", ci)) == shown


@pytest.mark.parametrize(
    ("typical", "unit", "factor", "shown"),
    [
        (3.2e-5, "m", 1e6, "um"),
        (0.0328, "V", 1e3, "mV"),
        (0.5, "V", 1.0, "V"),
        (2e-12, "V", 1e9, "nV"),
        (1e-5, "um", 1.0, "um"),  # has a prefix already
        (1e-5, "V/g", 1.0, "V/g"),
        (0.0, "V", 1.0, "V"),
        (math.nan, "V", 1.0, "V"),
    ],
)
def test_a_prefix_for_small_figures(typical: float, unit: str, factor: float, shown: str):
    assert wording.scaled(typical, unit) == (factor, shown)


def test_explained_is_not_asked_where_nothing_was_left():
    assert wording.explained(agrees().fit, "displacement") is None


def test_explained_stays_a_share_when_a_fit_harms_or_dips_below_the_noise():
    fit = missing_physics().fit
    assert wording.explained(replace(fit, fitted_rms={"displacement": 0.9}), "displacement") == 0.0
    assert wording.explained(replace(fit, fitted_rms={"displacement": 0.001}), "displacement") == 1.0


def test_windows_are_few():
    location = missing_physics().location
    assert wording.windows(location) == "0 to 3.5 s, 4 to 6 s"
    assert wording.windows(replace(location, windows=location.windows * 5)).endswith("and 4 more")
    assert wording.windows(agrees().location) == "none"


def test_poorly_known_is_more_than_thirty_percent():
    assert wording.poorly_known(ParameterValue(1.0, "s", (0.8, 1.2))) is None
    assert wording.poorly_known(ParameterValue(1.0, "s", (0.5, 1.5))) == pytest.approx(0.5)
    assert wording.poorly_known(ParameterValue(1.0, "s", (-math.inf, math.inf))) is None


def test_before_and_after_share_a_unit():
    p = replace(creep(), residual_rms_before=8.27e-5, residual_rms_after=4.34e-6)
    fit = replace(missing_physics().fit, unit={p.output: "m"})
    assert wording.before_after(p, fit) == "82.7 without it, 4.34 with it (um rms, held out)"


def test_figures_of_an_output_are_in_the_unit_of_its_file():
    p = replace(creep(), residual_rms_before=8.27e-5, residual_rms_after=4.34e-6)
    fit = replace(missing_physics().fit, unit={p.output: "m"}, file_unit={p.output: "mm"})
    assert wording.before_after(p, fit) == "0.0827 without it, 0.00434 with it (mm rms, held out)"
    assert wording.shown_in(fit, p.output, 3e-9) == (pytest.approx(1e3), "mm")
    # a difference knows nothing of where a scale begins
    assert wording.scaled(1.0, "degC", "K") == (1.0, "K")
    assert wording.scaled(1.0, "rad", "deg") == (pytest.approx(57.29578), "deg")


@pytest.mark.parametrize(
    ("name", "unit", "shown"),
    [
        ("time_constant_s", "s", "time constant"),
        ("corner_hz", "Hz", "corner"),
        ("loop_width_share", "1", "loop width share"),
        ("k_xx", "V/g^2", "k xx"),
    ],
)
def test_a_parameter_is_named_without_its_unit(name: str, unit: str, shown: str):
    assert wording.label(name, unit) == shown


def test_a_residual_far_above_the_noise_is_said_whatever_the_verdict():
    assert wording.cautions(missing_physics()) == ["displacement sits at its exact limits in 12 samples"]
    left = replace(agrees().fit, fitted_rms={"displacement": 0.2})
    assert wording.cautions(replace(agrees(), fit=left)) == ["what is left in displacement is 10 times the noise floor"]
    assert wording.cautions(replace(agrees(), verdict="unexplained", fit=left)) == []


def test_no_probability_is_believed_beyond_what_a_tail_can_say():
    assert wording.chance(8e-207) == "p < 1e-12"
    assert wording.chance(1e-9) == "p = 1e-09"


def test_two_figures_side_by_side_need_no_power_of_ten() -> None:
    assert [wording.number(v) for v in (7064.2, 890.1, 0.0123456, 2.5e7)] == ["7060", "890", "0.0123", "2.5e+07"]


def test_why_an_effect_is_not_named_is_said_with_the_figures_that_show_it():
    gap = ParameterValue(7e-5, "um", (-2.9e-4, 4.3e-4))
    held = Withheld("backlash", "displacement", "holds_zero", {"gap": gap}, ("gap",), 0.41, 0.4)
    fit = missing_physics().fit
    assert wording.why_withheld(held, fit) == (
        "its size may be zero: gap 0.00007 (-0.00029 .. 0.00043) um; 0.41 without it, 0.4 with it (um rms, held out)"
    )
    stuck = replace(held, reason="at_limit", shown_by=("half_gap",), replaced_by="hysteresis")
    said = wording.why_withheld(stuck, fit)
    assert said.startswith("half gap ended at a limit of the search")
    assert said.endswith("hysteresis is named instead")
    doubtful = replace(held, reason="unlikely", shown_by=())
    assert wording.why_withheld(doubtful, fit).startswith(
        "beside what is left unexplained it is too likely to be wrong"
    )
    led = replace(held, name="random_walk", reason="follows_signal", shown_by=("lamp",))
    assert wording.why_withheld(led, fit).startswith("it depends on no signal, but what it explains follows lamp;")


def test_a_rest_that_follows_nothing_is_not_said_to_be_above_a_known_floor() -> None:
    report = replace(missing_physics(), verdict="unexplained", meaning="unknown")
    assert report.location.depends_on
    assert wording.meaning(report).startswith("the noise floor is known well enough")
    alone = replace(report, location=replace(report.location, depends_on=()))
    assert "follows no recorded signal" in wording.meaning(alone)


@pytest.mark.parametrize(
    ("share", "text"),
    [(0.0, "0 %"), (0.00102, "0.1 %"), (0.0096, "1 %"), (0.366, "37 %"), (6.157, "616 %"), (1.3e25, "1.3e+27 %")],
)
def test_a_share_is_neither_nothing_nor_a_row_of_digits(share: float, text: str) -> None:
    assert wording.percent(share) == text
