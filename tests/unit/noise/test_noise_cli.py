"""Which columns ``micron noise`` takes when nobody says: all that change; of a run of the instrument its inputs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import Result

from tests.command import micron


def analysed(folder: Path, columns: dict[str, np.ndarray], *options: str) -> tuple[Result, list[str]]:
    np.savez(folder / "rest.npz", **columns)
    files = ["--json", str(folder / "noise.json"), "--picture", str(folder / "noise.png")]
    done = micron("noise", folder / "rest.npz", "--rate-hz", "100", *files, *options)
    found = folder / "noise.json"
    return done, list(json.loads(found.read_text())["columns"]) if found.exists() else []


@pytest.fixture
def white() -> np.ndarray:
    return np.random.default_rng(1).standard_normal(4000)


def test_columns_that_never_change_are_left_out_and_named(tmp_path: Path, white: np.ndarray) -> None:
    done, names = analysed(tmp_path, {"x": white, "frozen": np.ones(4000)})
    assert (done.exit_code, names) == (0, ["x"])
    assert "frozen" in done.stderr


def test_of_a_run_the_converters_inputs(tmp_path: Path, white: np.ndarray) -> None:
    done, names = analysed(tmp_path, {"tick": np.arange(4000.0), "volts_0": white, "volts_1": -white, "rate_x": white})
    assert (done.exit_code, names) == (0, ["volts_0", "volts_1"])
    assert "--column" in done.stderr


@pytest.mark.parametrize("options", [[], ["--column", "frozen"]])
def test_nothing_but_frozen_columns_ends_with_2(tmp_path: Path, options: list[str]) -> None:
    done, names = analysed(tmp_path, {"frozen": np.ones(4000)}, *options)
    assert (done.exit_code, names) == (2, [])
    assert "frozen sensor has no noise" in " ".join(done.stderr.split())
