"""A design from disk has scipy's bits; a broken file or another question does not get an old answer."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from firmware_py.designs import design
from hal.compiled import user_cache

POLES = np.array([-1.0 + 2.0j, -1.0 - 2.0j]) * 30.0


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return user_cache() / "designs"


def same_bits(found: tuple, wanted: tuple) -> None:
    assert len(found) == len(wanted)
    for a, b in zip(found, wanted, strict=True):
        assert np.asarray(a).shape == np.asarray(b).shape
        assert np.asarray(a).dtype == np.asarray(b).dtype
        assert np.array_equal(np.atleast_1d(a).view(np.uint64), np.atleast_1d(b).view(np.uint64))


def test_twice_the_bits_of_scipy(folder: Path) -> None:
    for _ in range(2):
        same_bits(design("iirpeak", 9.7, 3.3, fs=1000.0), signal.iirpeak(9.7, 3.3, fs=1000.0))
        same_bits(
            design("bilinear_zpk", np.zeros(2), POLES, 1.0, 1e3), signal.bilinear_zpk(np.zeros(2), POLES, 1.0, 1e3)
        )
        sections = design("ellip", 3, 0.5, 40.0, (7.0, 13.0), btype="bandpass", output="sos", fs=1000.0)
        same_bits(sections, (signal.ellip(3, 0.5, 40.0, (7.0, 13.0), btype="bandpass", output="sos", fs=1000.0),))
    assert len(list(folder.iterdir())) == 3


def test_the_answer_comes_from_disk_and_only_for_the_same_question(folder: Path) -> None:
    design("iirnotch", 20.0, 4.0, 1000.0)
    (file,) = folder.iterdir()
    table = json.loads(file.read_text())
    table["arrays"][0]["real"][0] = 0.25
    file.write_text(json.dumps(table))
    assert design("iirnotch", 20.0, 4.0, 1000.0)[0][0] == 0.25
    same_bits(design("iirnotch", 20.0, 4.5, 1000.0), signal.iirnotch(20.0, 4.5, 1000.0))


@pytest.mark.parametrize("text", ["", "{}", "[1]", '{"asked": "another", "arrays": []}'])
def test_a_broken_file_is_made_again(folder: Path, text: str) -> None:
    wanted = design("iirnotch", 20.0, 4.0, 1000.0)
    (file,) = folder.iterdir()
    file.write_text(text)
    for _ in range(2):
        same_bits(design("iirnotch", 20.0, 4.0, 1000.0), wanted)
    assert json.loads(file.read_text())["arrays"]


def test_a_folder_that_cannot_be_written_costs_no_design(folder: Path) -> None:
    folder.parent.mkdir(parents=True)
    folder.write_text("a file where the folder should be")
    same_bits(design("iirnotch", 20.0, 4.0, 1000.0), signal.iirnotch(20.0, 4.0, 1000.0))


@pytest.mark.slow
def test_a_start_with_designs_on_disk_leaves_scipy_signal_alone() -> None:
    look = "import sys; from benchmarks.step_input import stages; stages(); print('scipy.signal' in sys.modules)"
    said = [
        subprocess.run([sys.executable, "-c", look], capture_output=True, text=True, check=True).stdout.split()[-1]
        for _ in range(2)
    ]
    assert said == ["True", "False"]
