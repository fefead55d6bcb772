"""Rows of ``micron reproduce endoscope`` that can be judged in a second; what is not met says why."""

from __future__ import annotations

import pytest

from tools.research.reproduce import endoscope
from tools.research.reproduce.endoscope_broad import broad
from tools.research.reproduce.real_sensors import data_folder


def test_settling_times_are_the_printed_ones() -> None:
    for found in endoscope.settling():
        assert found.meets, found


@pytest.mark.skipif(not data_folder().is_dir(), reason="the shared recordings are not here")
def test_broad_and_the_beta_sweep() -> None:
    rows = broad()
    assert len(rows) == 8
    for found in rows:
        assert abs(found.ours - found.published) < 5e-4, found  # to the digits printed, not only to 0.1 degree
    least, quieter = endoscope.beta_sweep()
    assert quieter.meets
    assert least.kind == "not reproducible"
    assert least.why


@pytest.mark.slow
def test_every_row_is_met_or_says_why() -> None:
    rows = endoscope.table().rows
    assert len(rows) > 40
    for found in rows:
        assert found.meets or found.why, found
