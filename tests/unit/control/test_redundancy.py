"""What becomes of an axis that contradicts the others: left out, or the end of the run. ``Parity`` is the real one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_py.control.parity import ALONE_TICKS, LEARN_TICKS, PATIENCE_TICKS
from firmware_py.control.plan import load_plan
from firmware_py.control.plausibility import PlausibilityLimits, ScanCheck
from firmware_py.control.redundancy import Redundancy
from firmware_py.control.stages import StageConfigs, Stages
from firmware_py.frame import PARITIES, PARITY, STATUS, FrameStatus
from firmware_py.run.safety import State
from firmware_py.sensing.config import SensingConfig
from hal.bench import load_bench
from tests.unit.control.stand import StandRun

EIGHT = load_plan(load_bench(Path(__file__).parents[3] / "benches" / "micron-eight.toml")).stages
NULL = Stages(EIGHT).sensing.params["null"][0].copy()
NULL /= np.linalg.norm(NULL, axis=0)
"""Direction of each axis in the plane of two parities."""
BETWEEN = (NULL[:, 3] + NULL[:, 5]) / 2.0
"""This direction is as near to axis 3 as to axis 5, within 6 degrees of both."""


class Bench:
    """A redundancy of ``axes`` axes in the state ``state``; ``told`` is what the stage's parity would be."""

    def __init__(self, axes: int = 8, state: State = State.RUNNING) -> None:
        run = StandRun(state)
        self.supervisor, self.counts = run.supervisor, run.counts
        self.stages = Stages(EIGHT if axes == 8 else StageConfigs(SensingConfig(), EIGHT.tremor, EIGHT.actuation))
        labels = tuple(f"acc{i}" for i in range(axes))
        self.check = ScanCheck(PlausibilityLimits(), 5.0 / 32768, range(axes), labels, sensors=axes)
        self.frame = self.stages.frame
        self.redundancy = Redundancy(self.stages, self.check, run, labels)

    @property
    def left_out(self) -> list[int]:
        """The axes that sensing solves without: their columns of the solution are zero."""
        solve = self.stages.sensing.params["kinematics"]["solve"][0]
        return np.flatnonzero(~np.any(solve, axis=0)).tolist()

    def agree(self, told: Any, ticks: int = 1) -> str:
        """The last word of ``ticks`` ticks whose parity is ``told``; the first word that ends the run."""
        for _ in range(ticks):
            self.frame[PARITY : PARITY + len(PARITIES)] = told
            said = self.redundancy.agree(self.frame)
            if said:
                return said
        return ""

    def learnt(self) -> Bench:
        assert not self.agree((0.0, 0.0), LEARN_TICKS)
        return self


def test_the_axis_that_contradicts_is_left_out_and_the_run_goes_on() -> None:
    bench = Bench().learnt()
    assert not bench.agree(30.0 * NULL[:, 3])
    assert bench.left_out == [3]
    (said,) = bench.counts.noticed
    assert said.startswith("acc3 contradicts the other axes: left out")
    assert "noise of the tip's acceleration times 1." in said
    assert bench.frame[PARITY + 1] == 0.0  # one parity is left, and the other is no longer told
    assert not bench.agree((0.0, 0.0), LEARN_TICKS)


def test_the_second_axis_ends_the_run_for_nobody_can_tell_which_it_is() -> None:
    bench = Bench().learnt()
    bench.agree(30.0 * NULL[:, 3])
    assert not bench.agree((30.0, 0.0), ALONE_TICKS)
    assert "cannot be told which one is wrong" in bench.agree((30.0, 0.0))
    assert bench.left_out == [3]


def test_what_no_single_axis_explains_is_noticed_and_then_ends_the_run() -> None:
    bench = Bench().learnt()
    assert not bench.agree(100.0 * BETWEEN, PATIENCE_TICKS)
    assert list(bench.counts.noticed) == ["the accelerometer axes contradict each other"]
    assert "cannot be told" in bench.agree(100.0 * BETWEEN)
    assert not bench.left_out


def test_before_the_outputs_may_move_an_axis_is_refused_not_left_out() -> None:
    bench = Bench(state=State.SELF_TEST).learnt()
    assert not bench.agree(30.0 * NULL[:, 3])
    assert not bench.left_out
    assert bench.agree(100.0 * BETWEEN, 2 * PATIENCE_TICKS) == "the accelerometer axes (acc) contradict each other"
    assert bench.redundancy.impossible(3, "acc3 is at its rail") == "acc3 is at its rail"


def test_axes_that_step_together_are_their_supply() -> None:
    bench = Bench().learnt()
    bench.check.memory.state["together"][0] = 0
    assert "stepped together" in bench.agree(30.0 * NULL[:, 3])
    assert not bench.left_out


@pytest.mark.parametrize("status", [FrameStatus.INVALID, FrameStatus.STALE, FrameStatus.ALIGNING])
def test_a_tick_that_is_not_believed_says_nothing_of_the_axes(status: FrameStatus) -> None:
    bench = Bench().learnt()
    bench.frame[STATUS] = status
    assert not bench.agree(30.0 * NULL[:, 3], 2 * PATIENCE_TICKS)
    assert not bench.left_out


def test_an_impossible_reading_of_an_axis_is_left_out_and_of_another_input_trips() -> None:
    bench = Bench().learnt()
    assert bench.redundancy.has_spare_axes
    assert bench.redundancy.impossible(8, "the supply is gone") == "the supply is gone"
    assert bench.redundancy.impossible(5, "acc5 is at its rail") == ""
    assert bench.left_out == [5]
    assert next(iter(bench.counts.noticed)).startswith("acc5 is at its rail: left out")


def test_six_axes_have_none_to_spare() -> None:
    bench = Bench(axes=6)
    assert not bench.redundancy.has_spare_axes
    assert bench.redundancy.impossible(3, "acc3 is at its rail") == "acc3 is at its rail"
    assert not bench.agree((50.0, 50.0), 2 * PATIENCE_TICKS)
