"""The page of long runs keeps the other block, and is written into no other file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.command import micron
from tools.errors import InputError
from tools.research.faults.long_page import with_block
from tools.research.faults.long_run import EIGHTHS, PARTS, Eighths


def test_a_block_replaces_its_own_and_leaves_the_other(tmp_path: Path):
    page = tmp_path / "long.md"
    page.write_text(with_block(page, "wires", "## one\n"))
    page.write_text(with_block(page, "bare", "## two\n"))
    page.write_text(with_block(page, "wires", "## three\n"))
    text = page.read_text()
    assert [line for line in text.splitlines() if line.startswith("## ")] == ["## three", "## two"]


def test_another_page_is_not_overwritten(tmp_path: Path):
    page = tmp_path / "notes.md"
    page.write_text("# My notes\n")
    with pytest.raises(InputError, match="not a page of long runs"):
        with_block(page, "wires", "")
    result = micron("soak", "--seconds", "60", "--out", page)
    assert (result.exit_code, page.read_text()) == (2, "# My notes\n")


def test_a_start_of_the_clock_needs_a_clock():
    result = micron("soak", "--without-wires", "--start-ns", "5")
    assert result.exit_code == 2
    assert "--start-ns moves the clock of the buses" in result.stderr


def test_the_scatter_of_an_eighth_is_that_of_the_eighths():
    """The peer is the standard deviation of the eighths of many runs whose tremor wanders."""
    rng = np.random.default_rng(2)
    seen, said = list[float](), list[float]()
    for _ in range(100):
        run = Eighths(EIGHTHS * PARTS * 100.0)
        for k in range(EIGHTHS * PARTS):
            left = rng.normal(0.0, 1e-6 * (1.0 + 0.4 * rng.random()), (40, 3))
            run.add(100.0 * k + 50.0, left, rng.normal(0.0, 3e-6, (40, 3)))
        part = np.array(run.rms(1, 1.0)) / np.array(run.rms(2, 1.0))
        seen.append(float(np.std(part, ddof=1) / np.median(part)))
        said.append(run.scatter)
    # of eight eighths a standard deviation is too small in the mean, and its square is not
    assert np.sqrt(np.mean(np.square(said))) == pytest.approx(np.sqrt(np.mean(np.square(seen))), rel=0.1)
    assert Eighths(60.0).scatter == 0.0
