"""A campaign that is stopped keeps what is done."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from tests.conftest import DEFAULT_BENCH
from tools.interrupt import begin_command, is_stopped
from tools.research.faults import campaign
from tools.research.faults.campaign import Trial, run_campaign
from tools.research.faults.fault import Fault, InWorld
from tools.research.faults.judge import Observation

FAULTS = (Fault("one", InWorld("x", ""), "noticed"), Fault("two", InWorld("y", ""), "noticed"))


def observed(trial: Trial) -> list[Observation]:
    phase = trial.phase.name if trial.phase else "start"
    return [Observation.refusal(fault.name, trial.point, trial.seed, "no", phase) for fault in trial.faults]


@pytest.mark.parametrize("done", [0, 3])
def test_ctrl_c_keeps_what_is_done(monkeypatch: pytest.MonkeyPatch, done: int) -> None:
    def stopped(trials: Sequence[Trial], jobs: int) -> Iterator[tuple[Trial, list[Observation]]]:
        yield from ((trial, observed(trial)) for trial in trials[:done])
        raise KeyboardInterrupt

    monkeypatch.setattr(campaign, "_in_parallel", stopped)

    def run() -> list[campaign.FaultRow]:
        return run_campaign(DEFAULT_BENCH, FAULTS, seeds=[5], n_pairs=2, jobs=1, progress=lambda _: None)

    with begin_command():
        if done:
            assert sum(row.seeds for row in run()) == 2 * done
            assert is_stopped()
        else:
            with pytest.raises(KeyboardInterrupt):
                run()


def test_what_is_kept_is_not_done_again(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked: list[str] = []

    def note(trials: Sequence[Trial], jobs: int) -> Iterator[tuple[Trial, list[Observation]]]:
        for trial in trials:
            asked.append(trial.name)
            yield trial, observed(trial)

    monkeypatch.setattr(campaign, "_in_parallel", note)
    for _ in range(2):
        rows = run_campaign(
            DEFAULT_BENCH, FAULTS, seeds=[5], n_pairs=2, jobs=1, progress=lambda _: None, keep=tmp_path, revision="r"
        )
    assert len(asked) == len(set(asked)) == 16  # three hands in five phases, and the pairs
    assert sum(row.seeds for row in rows) == 2 * 15 + 2
