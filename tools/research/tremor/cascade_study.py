"""The experiment of Ang 2004, 5.3.3 and 5.3.4 on recorded hands: search of the network, one training file, cross
tests."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hal.arrays import Array
from tools.research.tremor.cascade import Cascade, CascadeNetwork
from tools.research.tremor.cascade_data import RATE_HZ, Making, Subject, learning_paths, voluntary
from tools.research.tremor.cascade_training import Trained, Training, train

WINDOWS = ((75, 1), (50, 2), (50, 4))
"""Inputs and their spacing in samples of 4 ms that are tried; 5.3.4 found 50 to 100 without spacing."""
TEST_SEED = 2


@dataclass(frozen=True)
class FileScore:
    """rms error against the voluntary motion, m, before and after the network, from where its window has filled."""

    raw: float
    left: float

    @property
    def reduction_percent(self) -> float:
        return 100.0 * (1.0 - self.left / self.raw)


@dataclass(frozen=True)
class SubjectResult:
    """The best network of one person's first file and how it does on the person's other files."""

    name: str
    trained: Trained
    own: tuple[FileScore, ...]

    @property
    def own_percent(self) -> float:
        return mean_percent(self.own)


@dataclass(frozen=True)
class Study:
    """``cross_percent`` (i, j): network of person i on all files of person j (i's own training file left out).

    ``held_out_percent``: per person, a network trained on one file of every other person. ``linear_percent``: the same
    with no hidden unit, which is the best linear filter of that window.
    """

    making: Making
    results: tuple[SubjectResult, ...]
    error_results: tuple[SubjectResult, ...]
    cross_percent: Array
    held_out_percent: tuple[float, ...]
    linear_percent: tuple[float, ...]

    @property
    def cross_mean_percent(self) -> float:
        """Over all pairs of different people."""
        return float(np.mean(self.cross_percent[~np.eye(len(self.cross_percent), dtype=bool)]))

    @property
    def worse_than_raw(self) -> int:
        """Pairs of different people for which the network does harm."""
        return int(np.sum(self.cross_percent[~np.eye(len(self.cross_percent), dtype=bool)] < 0.0))


def score(network: CascadeNetwork, error: Array, wanted: Array) -> FileScore:
    """The runtime kernel over one file."""
    filled = (network.window * network.spacing) - 1
    found = Cascade(network).run(error + wanted)
    left = (error - found)[filled:]
    return FileScore(float(np.sqrt(np.mean(error[filled:] ** 2))), float(np.sqrt(np.mean(left**2))))


def mean_percent(scores: Sequence[FileScore]) -> float:
    return float(np.mean([s.reduction_percent for s in scores]))


def search(
    errors: list[Array], making: Making, how: Training, windows: Sequence[tuple[int, int]], motions: int, note: str = ""
) -> Trained:
    """The network that validates best over ``windows`` and 0 to ``how.units`` hidden units."""
    fit, hold = learning_paths(errors, making, motions)
    tried = [train(fit, hold, RATE_HZ, replace(how, window=w, spacing=s), note) for w, s in windows]
    return min(tried, key=lambda t: min(t.validation_error))


def study(
    people: list[Subject],
    making: Making,
    windows: Sequence[tuple[int, int]] = WINDOWS,
    motions: int = 2,
    with_error_target: bool = True,
    progress: Callable[[str], None] = lambda _: None,
) -> Study:
    """Everything of section 5.3.4. Networks see a person's first file (``subjects`` puts the one of median size first);
    tests use another voluntary motion."""
    how = Training()
    wanted = voluntary(making, TEST_SEED)

    def own(target_how: Training) -> tuple[SubjectResult, ...]:
        found: list[SubjectResult] = []
        for person in people:
            progress(f"{person.name}, target {target_how.target}")
            trained = search([person.errors[0]], making, target_how, windows, motions)
            scores = tuple(score(trained.network, e, wanted) for e in person.errors[1:])
            found.append(SubjectResult(person.name, trained, scores))
        return tuple(found)

    results = own(replace(how, target="voluntary"))
    error_results = own(replace(how, target="error")) if with_error_target else ()
    cross = np.array(
        [
            [
                mean_percent([score(r.trained.network, e, wanted) for e in p.errors[1 if p.name == r.name else 0 :]])
                for p in people
            ]
            for r in results
        ]
    )
    held_out: list[float] = []
    linear: list[float] = []
    for person in people:
        progress(f"everyone but {person.name}")
        others = [p.errors[0] for p in people if p is not person]
        trained = search(others, making, how, windows[-1:], 1)
        for into, network in ((held_out, trained.network), (linear, trained.linear)):
            into.append(mean_percent([score(network, e, wanted) for e in person.errors]))
    return Study(making, results, error_results, cross, tuple(held_out), tuple(linear))
