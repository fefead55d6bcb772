"""A plan on a lag that a slow recording cannot tell from a delay: what is grouped, what splits it, what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter
from typer.testing import CliRunner

from sim_devices.physics.catalogue import EFFECTS
from sim_devices.physics.effect import Stage
from tests.recording_text import channel, stack_channels
from tools.cli.main import app
from tools.errors import InputError, RecordingError
from tools.mismatch.placed import Placed
from tools.mismatch.plan.design import Plan, design
from tools.mismatch.plan.limits import MOST_SAMPLES, Wish, parse_band, settle_limits
from tools.mismatch.plan.models import Rival, distance, evidence, pairs_of, separation, separations
from tools.mismatch.plan.plan import Asked, limits_of, open_situation, plan_for, prospect, stacks_of
from tools.mismatch.plan.separable import separable
from tools.mismatch.plan.situation import Situation, noisy, problem_of, simulated, situation, with_outputs
from tools.mismatch.plan.waveforms import FAMILIES, SIZE, draw, mean_square, random_multisine
from tools.mismatch.plan.write import write_plan
from tools.mismatch.recording import Array
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_start import prepare

RATE_HZ, N, TAU_S, NOISE_UM = 500.0, 1500, 0.004, 0.02

DESCRIPTOR = """format = 1
{data}rate_hz = 500.0
[twin]
kind = "piezo_stack"
parameters = {{ gain_um_per_V = 0.12, offset_um = 0.0, hold = "linear" }}
""" + stack_channels("command_V", "displacement_um")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("plan") / "slow"
    folder.mkdir()
    t = np.arange(N) / RATE_HZ
    u = 50 + 25 * np.sin(2 * np.pi * 0.4 * t) + 15 * np.sin(2 * np.pi * 0.9 * t + 1)
    a = np.exp(-1 / RATE_HZ / TAU_S)
    y = 0.12 * (lfilter([1 - a], [1, -a], u - u[0]) + u[0]) + np.random.default_rng(1).normal(0, NOISE_UM, N)
    table = np.column_stack([u, y])
    np.savetxt(folder / "data.csv", table, delimiter=",", header="command_V,displacement_um", comments="")
    text = DESCRIPTOR.format(data='data = "data.csv"\n') + f"noise_rms = {NOISE_UM}\n"
    (folder / "recording.toml").write_text(text)
    return folder


@pytest.fixture(scope="module")
def report() -> dict[str, Any]:
    """What a diagnosis says of that recording, as far as a plan reads it."""
    lag = {
        "name": "first_order_lag", "equation": EFFECTS["first_order_lag"].equation, "site": "input",
        "target": "command", "stage": "amplifier", "outputs": ["displacement"], "settings": {},
        "raw": {EFFECTS["first_order_lag"].parts({}).nonlinear[0].name: TAU_S},
    }  # fmt: skip
    base = [{"name": n, "given": v, "with_effects": v} for n, v in (("offset_um", 0.0), ("gain_um_per_V", 0.12))]
    return {
        "format": 1, "verdict": "missing_physics", "twin": "piezo_stack", "physics": [lag],
        "corrected_base": {"gain_um_per_V": 0.12, "offset_um": 0.0},
        "fit": {"unit": {"displacement": "um"}, "noise_floor_rms": {"displacement": NOISE_UM}, "base_parameters": base},
        "equivalent": [{"names": ["first_order_lag", "dead_time"], "tell_apart_by": ""}],
    }  # fmt: skip


def lag_and_delay(where: Situation) -> tuple[Rival, Rival]:
    output = ("displacement",)
    problem = problem_of(where.template, SIGMA)
    rest, at = Model(problem.twin), problem.twin.start(where.template)

    def placed(name: str, stage: Stage) -> Placed:
        return prepare(rest, problem.fit_view, at, Placed(EFFECTS[name], "output", "displacement", stage, output))

    lag, delay = placed("first_order_lag", "sensor"), placed("dead_time", "acquisition")
    base = [0.0, 0.12]
    return (
        Rival("first_order_lag", (lag,), np.array([*base, TAU_S])),
        Rival("dead_time", (delay,), np.array([*base, TAU_S])),
    )


SIGMA = {"displacement": NOISE_UM}


def test_a_plan_for_a_long_recording_is_as_long_as_a_plan_may_be():
    box = settle_limits(Wish(), "V", 1 / RATE_HZ, np.sin(np.arange(90_000) / 50), "x", None)
    assert box.duration_s == pytest.approx(MOST_SAMPLES / RATE_HZ)


def test_waveforms_of_every_family_stay_within_the_limits(recorded: Path):
    box = settle_limits(Wish(20.0, 50.0, 900.0, (0.5, 30.0), 3.0), "V", 1 / RATE_HZ, None, "x", None)
    rng = np.random.default_rng(0)
    for family in FAMILIES:
        for _ in range(20):
            u = draw(family, rng.random(SIZE[family]), box, 1 / RATE_HZ)
            assert np.max(np.abs(u - 50.0)) <= 20.0 + 1e-9
            assert np.max(np.abs(np.diff(u))) * RATE_HZ <= 900.0 * (1 + 1e-9)
            assert u.size == 1500


def test_a_random_multisine_has_the_energy_that_was_asked_for():
    box = settle_limits(Wish(20.0, 50.0, None, None, 3.0), "V", 1 / RATE_HZ, None, "x", None)
    u = random_multisine(np.random.default_rng(1), box, 1 / RATE_HZ, 77.0)
    assert mean_square(u, box) == pytest.approx(77.0)


def test_distance_is_the_expected_log_likelihood_ratio(recorded: Path):
    """Half the squared distance is the mean log ratio over noise, within three standard errors."""
    where = situation(recorded)
    lag, delay = lag_and_delay(where)
    t = np.arange(N) / RATE_HZ
    course = where.course({"command": 50 + 0.8 * np.sin(2 * np.pi * 12 * t) + 0.8 * np.sin(2 * np.pi * 3 * t)})
    d = distance(course, lag, delay, SIGMA)
    assert d > 3.0
    truth = _outputs(course, lag)
    ratios = [
        evidence(with_outputs(course, noisy(truth, SIGMA, np.random.default_rng(k))), lag, delay, SIGMA)[0]
        for k in range(12)
    ]
    assert abs(np.mean(ratios) - d**2 / 2) < 3 * d / np.sqrt(len(ratios)) + 1.0


def test_parameters_without_influence_are_no_evidence(recorded: Path):
    """At rest neither model moves: a rival with a parameter more or less is neither favoured nor rejected."""
    where = situation(recorded)
    lag, _ = lag_and_delay(where)
    plain = Rival("none", (), lag.theta[:2])
    course = where.course({"command": np.full(N, 50.0)})
    measured = with_outputs(course, noisy(_outputs(course, lag), SIGMA, np.random.default_rng(3)))
    for a, b in ((lag, plain), (plain, lag)):
        assert max(np.abs(evidence(measured, a, b, SIGMA))) < 1.0


def test_a_floor_ends_a_comparison_early_and_changes_nothing_above_it(recorded: Path):
    where = situation(recorded)
    pair = lag_and_delay(where)
    course = where.course({"command": 50 + 2.0 * np.sin(2 * np.pi * 8 * np.arange(N) / RATE_HZ)})
    whole = separation(course, pair, SIGMA, thorough=True)
    assert separation(course, pair, SIGMA, floor=0.5 * whole, thorough=True) == pytest.approx(whole, rel=1e-3)
    assert separation(course, pair, SIGMA, floor=2.0 * whole, thorough=True) <= 2.0 * whole


def test_the_closest_of_several_pairs_decides_first(recorded: Path, monkeypatch: pytest.MonkeyPatch):
    """Pairs that are far apart cost no thorough re-fit where the closest one rules an input out."""
    where = situation(recorded)
    apart = {"ab": 9.0, "ac": 3.0, "bc": 6.0}
    asked: list[tuple[str, bool]] = []

    def known(course: Any, a: Rival, b: Rival, *_: Any, thorough: bool) -> float:
        pair = "".join(sorted((a.name, b.name)))
        asked.append((pair, thorough))
        return apart[pair]

    monkeypatch.setattr("tools.mismatch.plan.models.distance", known)
    pairs = pairs_of([Rival(n, (), np.zeros(0)) for n in "abc"])
    course = where.course(dict(where.template.inputs))
    assert separations(course, pairs, SIGMA, thorough=True) == pytest.approx({"a / b": 9.0, "a / c": 3.0, "b / c": 6.0})
    asked.clear()
    assert separations(course, pairs, SIGMA, floor=3.5, thorough=True) == pytest.approx({"a / c": 3.0})
    assert not any(careful for _, careful in asked)
    asked.clear()
    assert separations(course, pairs, SIGMA, floor=3.5, thorough=True) == pytest.approx({"a / c": 3.0})
    assert {pair for pair, _ in asked} == {"ac"}
    asked.clear()
    assert min(separations(course, pairs, SIGMA, floor=2.0, thorough=True).values()) == pytest.approx(3.0)
    assert [pair for pair, careful in asked if careful] == ["ac", "ac", "bc", "bc", "ab", "ab"]


def test_a_model_that_begins_at_rest_is_at_no_distance_from_itself_on_an_input_that_repeats(tmp_path: Path):
    file = tmp_path / "recording.toml"
    file.write_text(
        'format = 1\nrate_hz = 500.0\n[twin]\nkind = "state_space"\n[twin.parameters]\n'
        "A = [[0.0, 1.0], [-900.0, -30.0]]\nB = [[0.0], [900.0]]\nC = [[1.0, 0.0]]\n"
        '[[channels]]\ncolumn = "u"\nrole = "input"\nsignal = "drive"\nunit = "V"\n'
        '[[channels]]\ncolumn = "y"\nrole = "output"\nsignal = "response"\nunit = "V"\n'
    )
    where = situation(file)
    levels = np.repeat(np.array([5.0, -3.0, 2.0, -4.0]), 50)
    course = where.course({"drive": np.tile(levels, 5)})
    twin = problem_of(course, {"response": 1e-3}).twin
    own = Rival("none", (), twin.start(course))
    assert distance(course, own, own, {"response": 1e-3}, thorough=True) < 0.1


def _outputs(course: Any, rival: Rival) -> dict[str, Array]:
    from tools.mismatch.twins.make import make

    return simulated(course, Model(make(course), rival.placed), rival.theta)


def test_a_slow_input_groups_lag_and_delay_and_a_sweep_would_split_them(recorded: Path):
    where = situation(recorded)
    effects = [EFFECTS[n] for n in ("first_order_lag", "dead_time", "backlash")]
    box = {"command": settle_limits(Wish(), "V", 1 / RATE_HZ, where.template.inputs["command"], "x", None)}
    slow = separable(where, box, SIGMA, size=2.0, given=dict(where.template.inputs), effects=effects)
    assert slow.groups == (("dead_time", "first_order_lag"),)
    assert slow.splitters[0].size is not None
    assert slow.splitters[0].size < 0.5
    fast = separable(where, box, SIGMA, size=2.0, effects=effects)
    assert fast.groups == ()


def test_an_effect_that_a_more_general_one_imitates_everywhere_is_listed(recorded: Path):
    where = situation(recorded)
    effects = [EFFECTS[n] for n in ("hysteresis", "rate_dependent_hysteresis", "dead_time")]
    box = {"command": settle_limits(Wish(), "V", 1 / RATE_HZ, where.template.inputs["command"], "x", None)}
    found = separable(where, box, SIGMA, size=3.0, effects=effects)
    assert found.imitated == (("hysteresis", "rate_dependent_hysteresis"),)
    assert found.groups == ()


@pytest.fixture(scope="module")
def planned(recorded: Path) -> tuple[Situation, Plan]:
    where = open_situation(recorded, Asked())
    box = limits_of(where, Asked())
    return where, design(where, lag_and_delay(where), box, SIGMA, evaluations=30, seed=2)


def test_the_plan_separates_far_better_than_what_was_recorded(planned: tuple[Situation, Plan]):
    where, plan = planned
    lag, delay = lag_and_delay(where)
    before = distance(where.course(dict(where.template.inputs)), lag, delay, SIGMA)
    assert before < 2.0
    assert plan.separation > 20 * before
    assert plan.separation > plan.random_separation


def test_the_same_seed_gives_the_same_plan(planned: tuple[Situation, Plan]):
    where, plan = planned
    again = design(where, lag_and_delay(where), plan.limits, SIGMA, evaluations=30, seed=2)
    np.testing.assert_array_equal(again.waves["command"], plan.waves["command"])


def test_files_hold_the_input_and_a_program_of_the_bench(planned: tuple[Situation, Plan], tmp_path: Path):
    from firmware_py.control.program import load_program

    where, plan = planned
    files = write_plan(plan, where, tmp_path, (2,))
    assert [f.name for f in files] == ["input.csv", "input.npz", "program.toml"]
    with np.load(tmp_path / "input.npz") as archive:
        np.testing.assert_array_equal(archive["command_V"], plan.waves["command"])
    csv = np.genfromtxt(tmp_path / "input.csv", delimiter=",", names=True)
    np.testing.assert_allclose(csv["command_V"], plan.waves["command"], rtol=1e-8)
    program = load_program(tmp_path / "program.toml")
    assert program.stacks == (1,)
    np.testing.assert_allclose(program.volts[::2], plan.waves["command"][: program.volts[::2].size], atol=1e-4)


def test_a_report_with_an_equivalent_group_is_planned_for(recorded: Path, report: dict[str, Any]):
    found = plan_for(recorded, report, Asked(evaluations=24))
    assert [r.name for r in found.rivals] == ["first_order_lag", "dead_time"]
    assert found.plan.separation > 10.0
    body = found.to_json()
    assert body["separation_sd"] == found.plan.separation


def test_before_any_recording_a_description_without_data_is_enough(tmp_path: Path):
    file = tmp_path / "recording.toml"
    file.write_text(DESCRIPTOR.format(data="") + "noise_rms = 0.02\n")
    found = prospect(file, Asked(Wish(amplitude=30.0, centre=50.0, duration_s=3.0)))
    assert {"hysteresis", "creep"} <= {s.name for s in found.found.visible}
    assert found.channels["temperature"] == ("temperature_sensitivity",)
    assert "misalignment" in found.found.not_here
    assert found.isolable == (("input command", "output displacement"),)


@pytest.mark.parametrize(
    ("wish", "message"),
    [
        (Wish(), "add --amplitude"),
        (Wish(amplitude=-1.0), "--amplitude -1"),
        (Wish(amplitude=1e9), "--amplitude 1e.09: must be a positive number below 1e9"),
        (Wish(amplitude=1e-10, centre=2.0), "--amplitude 1e-10: is lost beside the centre 2; give 2e-09 or more"),
        (Wish(amplitude=1.0, centre=float("nan")), "--centre nan: must be a number"),
        (Wish(amplitude=10.0, duration_s=0.01), "--duration 0.01"),
        (Wish(amplitude=10.0, band_hz=(1.0, 900.0)), "half the sampling rate"),
        (Wish(amplitude=10.0, band_hz=(0.001, 1.0)), "no half period"),
    ],
)
def test_impossible_wishes_are_refused_by_one_message(wish: Wish, message: str):
    with pytest.raises(InputError, match=message):
        settle_limits(wish, "V", 1 / RATE_HZ, None, "twin.toml", None)


def test_an_input_that_was_recorded_at_rest_is_no_wish():
    assert settle_limits(Wish(), "V", 1 / RATE_HZ, np.full(900, 3.0), "x", None).amplitude == 0.0


def test_limits_outside_the_bench_are_refused():
    bench = {"low": 0.0, "high": 100.0, "neutral": 50.0, "rate": 20_000.0}
    with pytest.raises(InputError, match=r"leaves the bench's 0 to 100 V.* at most 50"):
        settle_limits(Wish(amplitude=60.0), "V", 1 / RATE_HZ, None, "x", bench)
    with pytest.raises(InputError, match="moves by at most 20000 V/s"):
        settle_limits(Wish(rate_per_s=30_000.0), "V", 1 / RATE_HZ, None, "x", bench)
    with pytest.raises(InputError, match="--centre 120: must lie within the bench's 0 to 100 V"):
        settle_limits(Wish(centre=120.0, amplitude=5.0), "V", 1 / RATE_HZ, None, "x", bench)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--amplitude", "60"), "leaves the bench's 0 to 100 V"),
        (("--centre", "-5"), "--centre -5: must lie within the bench's 0 to 100 V"),
        (("--amplitude", "10", "--rate", "1e6"), "the bench's output moves by at most"),
    ],
)
def test_one_message_for_a_plan_that_the_bench_cannot_play(
    recorded: Path, tmp_path: Path, options: tuple[str, ...], message: str
):
    json_file = tmp_path / "plan.json"
    command = ["mismatch", "plan", str(recorded), "--bench", "micron", "--json", str(json_file), *options]
    found = CliRunner().invoke(app, command)
    assert found.exit_code == 2, found.output
    said = " ".join(found.stderr.split())
    assert said.count("micron: ") == 1
    assert message in said
    assert not found.stdout
    assert not json_file.exists()


def test_a_bench_is_refused_for_inputs_that_are_not_voltages(tmp_path: Path):
    file = tmp_path / "recording.toml"
    file.write_text(
        """format = 1
rate_hz = 500.0
[twin]
kind = "mechanical_axis"
parameters = { inverse_mass = 2.0, damping = 1.0, stiffness = 100.0 }
"""
        + channel("f", "input", "force", "N")
        + channel("x", "output", "position", "m", 1e-5)
    )
    with pytest.raises(InputError, match="none of its inputs is in V"):
        limits_of(open_situation(file, Asked()), Asked(bench={"low": 0.0, "high": 100.0, "neutral": 50.0, "rate": 1e4}))


def two_inputs(folder: Path, units: tuple[str, str]) -> Path:
    """Write a twin of two inputs without data."""
    drives = "".join(
        f'[[channels]]\ncolumn = "{s}"\nrole = "input"\nsignal = "{s}"\nunit = "{unit}"\n'
        for s, unit in zip(("left", "right"), units, strict=True)
    )
    file = folder / "recording.toml"
    file.write_text(
        f"""format = 1
rate_hz = 500.0
[twin]
kind = "state_space"
parameters = {{ A = [[-10.0]], B = [[1.0, 2.0]], C = [[1.0]] }}
{drives}[[channels]]
column = "y"
role = "output"
signal = "y"
unit = "m"
noise_rms = 1e-3
"""
    )
    return file


def test_two_planned_inputs_move_two_stacks(tmp_path: Path):
    from firmware_py.control.program import load_program

    where, signals = situation(two_inputs(tmp_path, ("V", "V"))), ("left", "right")
    stacks = stacks_of(where, signals, Asked(stacks=(3, 1)))
    assert stacks == (3, 1)
    assert stacks_of(where, signals, Asked()) == (1, 2)
    assert stacks_of(where, signals[:1], Asked()) == (1, 2, 3)
    waves: dict[str, Array] = {"left": 50.0 + np.arange(50) / 5.0, "right": 50.0 - np.arange(50) / 10.0}
    plan = Plan(waves, {}, 1 / 500.0, "ramps", 1.0, 1.0, {}, 1)
    write_plan(plan, where, tmp_path, stacks)
    program = load_program(tmp_path / "program.toml")
    assert program.stacks == (2, 0)
    np.testing.assert_allclose(program.volts[::2], np.column_stack([waves["left"], waves["right"]]), atol=1e-4)


@pytest.mark.parametrize("stacks", [(2,), (1, 1), (1, 2, 3)])
def test_each_of_two_inputs_has_one_stack(tmp_path: Path, stacks: tuple[int, ...]):
    where = situation(two_inputs(tmp_path, ("V", "V")))
    with pytest.raises(InputError, match=r"2 inputs are planned .left, right., and each moves a stack of its own"):
        stacks_of(where, ("left", "right"), Asked(stacks=stacks))


def test_a_program_of_the_bench_is_refused_for_an_input_that_is_no_voltage(tmp_path: Path, report: dict[str, Any]):
    file = two_inputs(tmp_path, ("V", "N"))
    bench = {"low": 0.0, "high": 100.0, "neutral": 50.0, "rate": 1e4}
    with pytest.raises(InputError, match="a program plays volts, and right is in N; add --input left"):
        stacks_of(situation(file), ("left", "right"), Asked(bench=bench))


def test_a_report_of_another_twin_or_without_a_group_is_refused(recorded: Path, report: dict[str, Any]):
    with pytest.raises(InputError, match="the report is of a state_space"):
        plan_for(recorded, {**report, "twin": "state_space"}, Asked())
    given = [{"name": n, "given": v, "with_effects": v} for n, v in (("offset_um", 0.0), ("gain_um_per_V", 0.2))]
    moved = {**report["fit"], "base_parameters": given}
    with pytest.raises(InputError, match="of another twin"):
        plan_for(recorded, {**report, "fit": moved}, Asked())
    with pytest.raises(InputError, match="the report has no physics"):
        plan_for(recorded, {"format": 1, "verdict": "leaves", "twin": "twin.toml", "fit": {}}, Asked())
    with pytest.raises(InputError, match="nothing to split"):
        plan_for(recorded, {**report, "equivalent": []}, Asked())


def test_what_is_not_known_of_a_twin_is_said(tmp_path: Path):
    with pytest.raises(RecordingError, match="no such recording"):
        prospect(tmp_path / "none.toml", Asked())
    file = tmp_path / "twin.toml"
    file.write_text('[twin]\nkind = "state_space"\n[twin.parameters]\nA = [[-1.0]]\nB = [[1.0]]\nC = [[1.0]]\n')
    with pytest.raises(InputError, match="no standard channels"):
        prospect(file, Asked(noise=0.1))
    quiet = tmp_path / "recording.toml"
    quiet.write_text(DESCRIPTOR.format(data=""))
    with pytest.raises(InputError, match="noise of 'displacement' is not known"):
        prospect(quiet, Asked(Wish(amplitude=30.0)))


@pytest.mark.parametrize("text", ["5", "3:1", "0:4", "a:b", "1:2:3"])
def test_a_band_is_two_rising_frequencies(text: str):
    with pytest.raises(InputError, match="LOW:HIGH"):
        parse_band(text)
