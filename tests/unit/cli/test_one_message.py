"""Bad input to a command: one line on standard error, exit status 2, and no work before it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.command import micron


def refused(*words: str) -> str:
    """Return the one message with which a command refuses ``words``."""
    result = micron(*words)
    assert result.exit_code == 2, (result.exit_code, result.output, result.exception)
    assert not result.stdout
    assert "Traceback" not in result.stderr
    message = result.stderr
    if message.startswith("Usage"):
        return " ".join(message.split("Error", 1)[1].replace("│", " ").split())
    assert message.count("\n") == 1, message
    return message


def too_late(*_: object) -> None:
    """Stand in for what must not be reached."""
    raise AssertionError("compiled before the input was read")


@pytest.mark.parametrize("command", ["run", "bench"])
@pytest.mark.parametrize(("hand", "says"), [("gone.csv", "does not exist; name an .npz"), (".", "recording.toml does")])
def test_a_hand_is_read_before_anything_is_compiled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, hand: str, says: str
) -> None:
    monkeypatch.setattr(f"tools.cli.{command}.prepare", too_late)
    monkeypatch.chdir(tmp_path)
    assert says in refused(command, "--hand", hand)


def test_a_path_that_is_not_there_cannot_be_trusted(tmp_path: Path) -> None:
    assert "there is no such file or folder" in refused("trust", str(tmp_path), str(tmp_path / "gone"))


@pytest.mark.parametrize("words", [("mismatch", "diagnose"), ("noise",), ("mismatch", "new"), ("run", "--bench")])
def test_links_that_run_in_a_circle_are_named(tmp_path: Path, words: tuple[str, ...]) -> None:
    circle = tmp_path / "circle.csv"
    circle.symlink_to(circle)
    assert "circle.csv" in refused(*words, str(circle))


@pytest.mark.parametrize("words", [("run", "--virtual"), ("endoscope", "play"), ("recover", "old.mcap")])
def test_a_recording_is_not_named_as_another_format(tmp_path: Path, words: tuple[str, ...]) -> None:
    option = "--out" if words[0] == "recover" else "--record"
    assert "x.csv: a recording ends in .mcap" in refused(*words, option, str(tmp_path / "x.csv"))


def test_a_bench_is_read_before_a_scan_says_what_it_will_do(tmp_path: Path) -> None:
    assert "name an existing bench file" in refused("scan", "--bench", str(tmp_path))


def test_a_signal_is_not_scaled_to_nothing(tmp_path: Path) -> None:
    assert "--scale 0" in refused("noise", str(tmp_path / "rest.csv"), "--scale", "0")


def test_a_log_without_samples_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "rest.npz", a=np.zeros(0))
    assert "its columns hold no samples" in refused("noise", str(tmp_path / "rest.npz"), "--rate-hz", "10")


def test_a_folder_for_recordings_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    message = refused("bench", "--bench", "endoscope", "--port", "0", "--recordings", str(tmp_path / "file"))
    assert "cannot be made (File exists); name a folder" in message


@pytest.mark.parametrize(
    ("out", "says"), [(".", "this is a folder"), ("no/x.png", "does not exist"), ("x.y", "ends in")]
)
def test_a_picture_is_checked_before_the_workspace_is_computed(tmp_path: Path, out: str, says: str) -> None:
    assert says in refused("manipulator", "--out", f"{tmp_path}/{out}")


def test_a_watched_twin_is_read_before_anything_is_compiled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tools.cli.run.prepare", too_late)
    twin = tmp_path / "twin.toml"
    twin.write_text("format = 1\n")
    assert "no [twin] table" in refused("run", "--virtual", "--seconds", "400", "--watch", str(twin))


@pytest.mark.parametrize("command", ["run", "bench", "simulate"])
def test_a_negative_seed_is_refused(command: str) -> None:
    assert "'--seed'" in refused(command, "--seed", "-1")


def test_a_full_device_and_a_folder_that_is_gone_are_one_message_even_for_the_help(tmp_path: Path) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    leave = f"import os, sys; os.chdir({str(gone)!r}); os.rmdir({str(gone)!r}); sys.argv = ['micron', '--help']; "
    run = "from tools.cli.main import main; main()"
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-c", f"import sys; sys.argv = ['micron', '--help']; {run}"],
            stdout=full, stderr=subprocess.PIPE, text=True, timeout=120,
        )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr == "micron: standard output: cannot be written (No space left on device); free some space\n"
    done = subprocess.run([sys.executable, "-c", leave + run], capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    assert done.stderr.startswith("micron: the working folder cannot be used (No such file or directory)")
    assert done.stderr.count("\n") == 1
