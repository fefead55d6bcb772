"""The time that a thread was kept waiting, from the kernel's file."""

from __future__ import annotations

from pathlib import Path

from firmware_py.machine.tree import Tree
from firmware_py.machine.waiting import SCHEDSTAT, kept_waiting_ns


def test_it_is_the_second_number(tmp_path: Path) -> None:
    tree = Tree(tmp_path)
    assert kept_waiting_ns(tree) == 0
    (tmp_path / SCHEDSTAT).parent.mkdir(parents=True)
    (tmp_path / SCHEDSTAT).write_text("813000 5100 42\n")
    assert kept_waiting_ns(tree) == 5100


def test_this_thread_has_one_that_does_not_fall() -> None:
    before = kept_waiting_ns()
    assert 0 <= before <= kept_waiting_ns()
