"""The closed loop without wires: the same tremor is left as over the wire, bits repeat, wrong benches are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from firmware_py.app import run_in_process
from firmware_py.frame import COMMAND, LAYOUT
from firmware_py.run_request import RunRequest
from hal.bench import load_bench
from tools.closed_loop.simulate import COMMAND_DELAY_S, simulate, wires_of
from tools.errors import InputError
from tools.reports.figures import tremor_figures

BENCH = Path(__file__).parents[3] / "benches" / "micron.toml"
SECONDS = 5.0
SETTLE_NS = 2_000_000_000


def left_um(truth, armed_ns: int, safe_ns: int) -> tuple[float, float]:
    scored = tremor_figures(truth, from_ns=armed_ns + SETTLE_NS, to_ns=safe_ns)
    assert scored is not None
    return scored.vector.uncompensated_rms_um, scored.vector.compensated_rms_um


def test_it_leaves_the_tremor_that_a_run_over_the_wire_leaves() -> None:
    outcome, truth = run_in_process(RunRequest(BENCH, SECONDS, pace="virtual"))
    assert truth is not None
    run = simulate(load_bench(BENCH), SECONDS)
    wire = left_um(truth, outcome["armed_ns"], outcome["safe_ns"])
    ours = left_um(run.truth, run.armed_ns, run.safe_ns)
    # the hand is the same; scans begin some ms apart, so that the windows differ by that
    assert ours[0] == pytest.approx(wire[0], rel=0.03)
    assert ours[1] == pytest.approx(wire[1], rel=0.10)
    assert ours[1] < 0.3 * ours[0]


def test_same_seed_same_bits_and_another_seed_another_hand() -> None:
    bench = load_bench(BENCH)
    a, b = (simulate(bench, 0.6, keep_frames=True) for _ in range(2))
    assert a.frames is not None
    assert b.frames is not None
    assert a.frames.shape == (1100, LAYOUT.size)
    assert np.array_equal(a.frames.view(np.uint64), b.frames.view(np.uint64))
    assert np.array_equal(a.truth["tip_m"], b.truth["tip_m"])
    assert not a.frames[:500, COMMAND].any()  # not armed
    assert np.ptp(a.frames[-50:, COMMAND]) > 0.0
    other = simulate(bench, 0.6, seed=7)
    assert not np.array_equal(a.truth["tip_rigid_m"], other.truth["tip_rigid_m"])


def test_a_later_command_leaves_more() -> None:
    """The delay is real: half a millisecond more costs about 2 pi 10 Hz 0.5 ms = 3 % of the tremor."""
    bench = load_bench(BENCH)
    early, late = (simulate(bench, SECONDS, delay_s=d) for d in (COMMAND_DELAY_S, COMMAND_DELAY_S + 0.4e-3))
    assert left_um(late.truth, late.armed_ns, late.safe_ns)[1] > left_um(early.truth, early.armed_ns, early.safe_ns)[1]


@pytest.mark.parametrize("delay_s", [-1e-6, 1e-3, float("nan")])
def test_a_delay_beyond_the_tick_is_refused(delay_s: float) -> None:
    with pytest.raises(InputError, match="less than a tick"):
        wires_of(load_bench(BENCH), 500, delay_s)


@pytest.mark.parametrize("name", ["micron-e727.toml", "micron-can.toml"])
def test_a_bench_with_another_output_is_refused(name: str) -> None:
    with pytest.raises(InputError, match="exactly one dac_amplifier"):
        simulate(load_bench(BENCH.with_name(name)), 1.0)


def test_block_by_block_is_the_same_run() -> None:
    bench = load_bench(BENCH)
    whole = simulate(bench, 0.6, keep_frames=True)
    assert whole.frames is not None
    frames, tips = [], []

    def keep(truth: np.ndarray, rows: np.ndarray) -> None:
        tips.append(truth[:, :3].copy())
        frames.append(rows.copy())

    run = simulate(bench, 0.6, on_block=keep)
    assert run.frames is None
    np.testing.assert_array_equal(np.concatenate(frames).view(np.uint64), whole.frames.view(np.uint64))
    first = np.flatnonzero(whole.truth["t_ns"] == whole.started_ns)[0] + 1
    np.testing.assert_array_equal(np.concatenate(tips), whole.truth["tip_m"][first:])


def test_every_step_of_the_plant_is_kept_and_the_run_stays_the_same() -> None:
    bench = load_bench(BENCH)
    plain, run = simulate(bench, 0.6), simulate(bench, 0.6, keep_fine=True)
    assert plain.fine is None
    assert run.fine is not None
    for name in ("tip_m", "tip_rigid_m"):
        np.testing.assert_array_equal(run.truth[name], plain.truth[name])
    first = np.flatnonzero(run.truth["t_ns"] == run.started_ns)[0] + 1
    seen = np.hstack([run.truth["tip_m"], run.truth["tip_rigid_m"]])[first:]
    np.testing.assert_array_equal(run.fine[7::8], seen)
