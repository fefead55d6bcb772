"""Constants are learned from searches with known answers, without another fit."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.unit.mismatch_engine.cases import recording, wave
from tools.mismatch.infer.constants import START, Constants
from tools.mismatch.infer.decide import decide, stated
from tools.mismatch.infer.run import infer
from tools.research.prove.calibration import calibrate, write_constants
from tools.research.prove.learn import (
    CLIP,
    Case,
    SetTraits,
    best_of,
    cross_validated,
    learn,
    learn_sure,
    raw_surenesses,
    traits_of,
)

SHORT = 3.0
"""Nats per sample by which a twin without effects is short of noise."""


def _set(names: str, gain: float, parameters: int = 2, z: float | None = 9.0, rest: float = 0.0) -> SetTraits:
    return SetTraits(frozenset(names), (SHORT - gain,), parameters, len(names), 0.0, z if names else None, rest, 1.0)


def _cases(rng: np.random.Generator, count: int, form_error: float) -> list[Case]:
    """One true name each; a false second name gains by chance up to ``form_error`` nats per sample."""
    out: list[Case] = []
    for i in range(count):
        gain = rng.uniform(0.3, 2.0)
        more = rng.uniform(0.0, form_error)
        sets = (_set("", 0.0, 0), _set("a", gain), _set("b", 0.6 * gain), _set("ab", gain + more, 5))
        out.append(Case(f"c{i}", "single", frozenset("a"), 900, sets, None))
    return out


def test_the_price_of_a_name_follows_the_error_of_forms() -> None:
    rng = np.random.default_rng(1)
    for form_error in (0.02, 0.3):
        cases = _cases(rng, 40, form_error)
        c = learn(cases)
        assert sum(case.right(c) for case in cases) >= 39
        assert np.mean([k.log_probability(c) for k in cases]) >= np.mean([k.log_probability(START) for k in cases])
        # a name with its parameters costs what the error of a form may seem to gain
        assert c.per_name + 3.0 * c.per_parameter > 0.8 * form_error * c.form_samples


def test_a_case_that_the_search_missed_costs_no_more_than_the_clip() -> None:
    missed = Case("c", "pair", frozenset("xy"), 900, (_set("", 0.0, 0), _set("a", 3.0)), None)
    assert missed.log_probability(START) == CLIP
    wrong = Case("c", "single", frozenset("b"), 900, (_set("", 0.0, 0), _set("a", 3.0), _set("b", 0.1)), None)
    assert wrong.log_probability(START) == CLIP


def test_a_name_must_pass_its_test_and_a_leftover_makes_it_no_account() -> None:
    sets = (_set("", 0.0, 0), _set("a", 1.0, z=2.0), _set("b", 0.9, z=8.0))
    case = Case("c", "single", frozenset("b"), 900, sets, None)
    assert case.right(replace(START, least_z=3.0))
    assert not case.right(replace(START, least_z=1.0))
    left = Case("c", "unknown", frozenset(), 900, (_set("", 0.0, 0), _set("a", 1.0, rest=4.0)), None)
    assert left.right(START)
    assert not left.right(replace(START, cut=5.0))
    followed = Case("c", "unknown", frozenset(), 900, (_set("", 0.0, 0), _set("a", 0.2)), (0.8, SHORT))
    assert followed.says(START)[0] == "unexplained"
    assert Case("c", "unknown", frozenset(), 900, followed.sets, None).says(START)[0] == "named"


def test_of_equal_options_the_nearest_to_the_start_is_taken() -> None:
    cases = [Case("c", "single", frozenset("a"), 900, (_set("", 0.0, 0), _set("a", 1.0, z=6.0)), None)]
    c = best_of(START, ({"least_z": z} for z in (1.0, 2.0, 4.0, 8.0, 16.0)), cases)
    assert c.least_z == 4.0


@pytest.mark.parametrize(("better", "worse", "taken"), [(1, 0, 4.0), (2, 1, 4.0), (3, 0, 8.0), (9, 3, 8.0)])
def test_a_difference_within_its_standard_error_takes_nothing_from_the_start(
    better: int, worse: int, taken: float
) -> None:
    """A test at 8 is right where one at 4 names too much, and wrong where it names nothing."""
    too_much = Case(
        "c", "pair", frozenset("b"), 900, (_set("", 0.0, 0), _set("a", 1.0, z=6.0), _set("b", 0.9, z=9.0)), None
    )
    too_little = Case("c", "single", frozenset("a"), 900, (_set("", 0.0, 0), _set("a", 1.0, z=6.0)), None)
    c = best_of(START, ({"least_z": z} for z in (4.0, 8.0)), [too_much] * better + [too_little] * worse)
    assert c.least_z == taken


def test_boastful_probabilities_are_lowered_on_cases_of_their_own() -> None:
    rng = np.random.default_rng(3)
    cases: list[Case] = []
    for i in range(300):
        true = "a" if rng.random() < 0.75 else "b"
        sets = (_set("", SHORT - 1.0, 0), _set("a", SHORT), _set("b", SHORT - 0.015))
        cases.append(Case(f"c{i}", "single", frozenset(true), 900, sets, None))
    before = np.mean([n.sure for n in raw_surenesses(START, cases)])
    c = learn_sure(START, list(raw_surenesses(START, cases[:150])))
    after = np.mean([stated(n.sure, n.known, c) for n in raw_surenesses(START, cases[150:])])
    assert before > 0.97
    assert after == pytest.approx(0.75, abs=0.06)


def test_cross_validation_counts_every_case_once() -> None:
    cases = _cases(np.random.default_rng(5), 20, 0.02)
    figures = cross_validated(cases, lambda some: START)
    assert figures.cases == len(figures.stated) == 20
    assert figures.exactly_right == sum(c.right(START) for c in cases)
    # in the order of the cases, because the caller excludes names by the kind of their case
    assert [list(of) for of in figures.stated] == [list(raw_surenesses(START, [c])) for c in cases]


def test_a_name_that_would_be_withheld_teaches_nothing() -> None:
    sets = (_set("", 0.0, 0), _set("a", 1.0, 2), _set("ab", 1.15, 4))
    case = Case("c", "single", frozenset("a"), 900, sets, None)
    names = list(raw_surenesses(START, [case]))
    assert case.says(START)[1].names == frozenset("ab")
    assert [(n.right, n.known) for n in names] == [(True, True)]


def test_what_is_learned_from_decides_as_the_engine_does() -> None:
    rng = np.random.default_rng(4)
    u = 40.0 * wave(rng, 2500)
    y = 0.12 * np.clip(u, -22.0, 25.0) + 0.01 * rng.standard_normal(u.size)
    stack = recording("piezo_stack", {"command": u}, {"displacement": y}, {"gain_um_per_V": 0.12, "offset_um": 0.0})
    inferred = infer(stack, START)
    traits = json.loads(json.dumps(traits_of(inferred), default=float))
    case = Case.of("c", "single", ["saturation"], traits)
    answer = decide(inferred.found.store, inferred.found.first)
    said, chosen = case.says(START)
    assert chosen.names == answer.chosen.names == {"saturation"}
    assert said == ("named" if answer.whole else "unexplained")
    scores = {s.names: inferred.found.store.score(s) for s in inferred.found.store.ranked()}
    sets = [s for s in case.ranked(START) if s.names in scores]
    assert any(s.laws > len(s.names) for s in sets)
    assert [case.score(s, START) for s in sets] == pytest.approx([scores[s.names] for s in sets])


def test_a_calibration_goes_on_where_it_was(tmp_path: Path) -> None:
    body, left = calibrate(tmp_path, 9, 1000, minutes=0.0)
    assert body is None
    assert left == 9
    assert not list(tmp_path.rglob("constants.json"))


def test_constants_are_written_whole(tmp_path: Path) -> None:
    body = {"format": 1, "constants": START.to_json(), "provenance": {"learned": True}}
    file = write_constants(body, tmp_path / "constants.json")
    assert Constants.of(json.loads(file.read_text())["constants"]) == START


def test_few_cases_cannot_vouch_for_much() -> None:
    few, many = (list(raw_surenesses(START, _cases(np.random.default_rng(5), n, 0.0))) for n in (6, 60))
    assert learn_sure(START, few).most_sure == pytest.approx(7 / 8)
    assert learn_sure(START, many).most_sure == pytest.approx(61 / 62)


def test_events_beside_a_set_are_part_of_its_answer_but_not_of_its_score() -> None:
    plain, eventful = _set("a", 1.0), replace(_set("a", 1.0), events={"bursts": 1e-9, "doubtful": 0.2})
    assert eventful.score(START, 900, 1.0) == plain.score(START, 900, 1.0)
    assert eventful.with_events(START) == {"a", "bursts"}
    case = Case("c", "pair", frozenset(("a", "bursts")), 900, (_set("", 0.0, 0), eventful), None)
    assert case.right(START)
    assert case.log_probability(START) > -1e-6


def test_names_beside_something_unexplained_are_stated_as_seldom_as_they_are_right() -> None:
    rng = np.random.default_rng(8)
    cases: list[Case] = []
    for i in range(200):
        whole = i % 2 == 0
        true = "a" if rng.random() < (0.95 if whole else 0.4) else "b"
        left = 0.0 if whole else 50.0
        sets = (_set("", -1.0, 0), replace(_set("a", 0.0), rest=left, explained=60.0), _set("b", -0.5))
        cases.append(Case(f"c{i}", "single", frozenset(true), 900, sets, None))
    c = learn_sure(START, list(raw_surenesses(START, cases[:100])))
    names = list(raw_surenesses(START, cases[100:]))
    for whole, share in ((True, 0.95), (False, 0.4)):
        said = [stated(n.sure, n.known, c) for n in names if n.known == whole]
        assert np.mean(said) == pytest.approx(share, abs=0.12)
