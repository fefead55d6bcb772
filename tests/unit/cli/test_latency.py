"""``micron latency``: loops that take turns, and the loop in C beside them. Asserts on counts, never on times."""

from __future__ import annotations

import io
import stat
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from rich.table import Table

from firmware_py.scheduler.histogram import DurationHistogram
from hal.errors import HalError
from tests.conftest import DEFAULT_BENCH
from tools.diagnose.c_reference import COMPILERS, CReference, compile_reference
from tools.diagnose.latency import Lateness, Loop, firmware_loop, loops_of, take_turns
from tools.diagnose.latency_tables import figures_table, histogram_table
from tools.diagnose.wake_kernel import wake

durations = st.lists(st.integers(0, 10**9), max_size=40)


def counted(values_ns: list[int]) -> DurationHistogram:
    histogram = DurationHistogram()
    histogram.add_all(values_ns)
    return histogram


@given(durations, durations)
def test_histograms_add_up(a: list[int], b: list[int]):
    both = counted(a)
    both.add_histogram(counted(b))
    assert both.words == counted(a + b).words


@given(durations)
def test_values_beyond_a_limit_are_counted_but_for_its_bucket(values_ns: list[int]):
    n = counted(values_ns).count_beyond(100_000)
    assert sum(v > 107_000 for v in values_ns) <= n <= sum(v > 100_000 for v in values_ns)


def late_by(what: str, values_us: list[int]) -> Loop:
    def measure(_seconds: float, histogram: DurationHistogram) -> str:
        histogram.add_all([1000 * v for v in values_us])
        return "granted"

    return Loop(what, "fifo", measure)


def test_loops_take_turns_and_their_ticks_add_up():
    found: list[Lateness] = []
    told = list(take_turns([late_by("a", [5, 50]), late_by("b", [500])], 3, 60.0, found))
    assert [text.split(",")[0] for text in told] == ["a", "b"] * 3
    assert "round 3 of 3" in told[-1]
    assert [(one.what, one.histogram.n, one.scheduling) for one in found] == [("a", 6, "granted"), ("b", 3, "granted")]
    assert found[1].as_dict()["beyond_us"] == {"100": 3, "1000": 0}


@pytest.mark.parametrize(("good_turns", "ticks"), [(0, [7]), (1, [2 + 7])])
def test_what_was_counted_until_ctrl_c_counts(good_turns: int, ticks: list[int]):
    turns = 0

    def measure(_seconds: float, histogram: DurationHistogram) -> str:
        nonlocal turns
        turns += 1
        histogram.add_all([1000] * (2 if turns <= good_turns else 7))
        if turns > good_turns:
            raise KeyboardInterrupt
        return ""

    found: list[Lateness] = []
    with pytest.raises(KeyboardInterrupt):
        list(take_turns([Loop("a", "fifo", measure)], 9, 1.0, found))
    assert [one.histogram.n for one in found] == ticks


def text_of(make: Callable[[list[Lateness]], Table], found: list[Lateness]) -> str:
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(make(found))
    return console.export_text()


@pytest.mark.parametrize("firmware", ["firmware", "firmware, compiled"])
def test_the_tables_of_many_hours_fit_on_eighty_columns(firmware: str):
    histogram = counted([900, 12_000, 40_000, 130_000, 12_345_678])
    histogram.words[4 + 200] += 604_800_000
    found = [
        Lateness(what, "fifo", "", histogram)
        for what in ("C reference", "compiled loop", "bare loop", "loop and pty", firmware)
    ]
    figures = text_of(figures_table, found)
    assert "604800005" in figures
    assert "12346" in figures
    assert "…" not in figures + text_of(histogram_table, found)


def test_without_a_compiler_it_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert compile_reference() == f"no C compiler ({', '.join(COMPILERS)}) on the path"
    broken = tmp_path / "cc"
    broken.write_text("#!/bin/sh\necho cannot find crt1.o >&2\nexit 1\n")
    broken.chmod(broken.stat().st_mode | stat.S_IXUSR)
    assert compile_reference() == f"{broken} cannot compile it: cannot find crt1.o"
    assert [loop.what for loop in loops_of("other", None, None)] == ["compiled loop", "bare loop", "loop and pty"]


def test_the_loops_in_c_and_compiled_never_wake_early():
    reference = compile_reference()
    for wakes in [wake, *([reference.wake] if isinstance(reference, CReference) else [])]:
        late_ns = np.full(5, -1, np.int64)
        wakes(late_ns, 1000, 0)  # due long ago: at once, then at times that are yet to come
        assert late_ns[0] > 0
        assert np.all(late_ns >= 0)


def test_the_firmware_of_a_bench_is_measured_in_python_or_compiled():
    def names(*, compiled: bool) -> list[str]:
        return [loop.what for loop in loops_of("other", None, DEFAULT_BENCH, compiled=compiled)][3:]

    assert names(compiled=False) == ["firmware"]
    assert names(compiled=True) == ["firmware, compiled"]


@pytest.mark.realtime
@pytest.mark.parametrize(("bench", "compiled"), [("endoscope", False), ("micron-e727", True)])
def test_the_firmware_of_either_instrument_counts_its_ticks(bench: str, compiled: bool):
    histogram = DurationHistogram()
    firmware_loop(DEFAULT_BENCH.with_name(f"{bench}.toml"), "other", 0.5, histogram, compiled=compiled)
    assert histogram.n > 0


def test_what_the_firmware_said_is_not_said_to_be_said_by_micron_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    done = subprocess.CompletedProcess([], 1, stdout="", stderr="micron: the budgets do not fit\n")
    monkeypatch.setattr("tools.diagnose.latency.subprocess.run", lambda *_, **__: done)
    with pytest.raises(HalError, match=r"^the budgets do not fit$"):
        firmware_loop(DEFAULT_BENCH, "other", 0.1, DurationHistogram())
