"""What is said of the loop before a run: compiled, or Python and which device is why."""

from __future__ import annotations

from pathlib import Path

import pytest

from hal.bench import load_bench
from hal.clock import Pace
from tests.conftest import DEFAULT_BENCH
from tools.reports.loop_lines import WIDTH, loop_lines

BENCHES = sorted(path for path in DEFAULT_BENCH.parent.glob("*.toml") if path.stem != "space-latt")
WHY = "loop:  Python, because this run cannot be compiled:"


@pytest.mark.parametrize("bench", BENCHES, ids=lambda path: path.stem)
def test_a_bench_that_cannot_run_compiled_names_what_keeps_it_from_it(bench: Path) -> None:
    lines = loop_lines(load_bench(bench), "realtime", compiled=False)
    assert max(map(len, lines)) <= WIDTH
    whys = {
        "micron-eight": "device.acc1, device.acc2, device.acc3, device.acc4: 8 accelerometer axes",
        "endoscope": "an endoscope's loop is Python",
        "imus": "an endoscope's loop is Python",
    }
    if bench.stem in whys:
        assert lines[0] == WHY
        assert whys[bench.stem] in " ".join(line.strip() for line in lines)
    else:
        assert lines == ["loop:  Python; --compiled runs it without the interpreter"]


def test_a_run_whose_orders_are_python_does_not_offer_the_compiled_thread() -> None:
    lines = loop_lines(load_bench(DEFAULT_BENCH), "realtime", compiled=False, orders=["--manual is Python"])
    assert lines == [WHY, "       --manual is Python"]


def test_a_compiled_run_says_so() -> None:
    (line,) = loop_lines(load_bench(DEFAULT_BENCH), "realtime", compiled=True, label="firmware:")
    assert line == "firmware: one compiled thread, Python beside it"


@pytest.mark.parametrize("pace", ["paced", "virtual"])
def test_emulated_time_has_nothing_to_choose(pace: Pace) -> None:
    assert loop_lines(load_bench(DEFAULT_BENCH), pace, compiled=False) == []
