"""Bad input to a command: one line on standard error, exit status 2, and no work before it."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from tools.cli.main import app


def refused(*words: str) -> str:
    """Return the one message with which a command refuses ``words``."""
    result = CliRunner().invoke(app, list(words))
    assert result.exit_code == 2, (result.exit_code, result.output, result.exception)
    assert not result.stdout
    assert "Traceback" not in result.stderr
    message = result.stderr
    if message.startswith("Usage"):
        return " ".join(message.split("Error", 1)[1].replace("│", " ").split())
    assert message.count("\n") == 1, message
    return message


@pytest.mark.parametrize("command", ["run", "bench"])
@pytest.mark.parametrize(("hand", "says"), [("gone.csv", "does not exist; name an .npz"), (".", "recording.toml does")])
def test_a_hand_is_read_before_anything_is_compiled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, hand: str, says: str
) -> None:
    def too_late(*_: object) -> None:
        raise AssertionError("compiled before the hand was read")

    monkeypatch.setattr(f"tools.cli.{command}.prepare", too_late)
    monkeypatch.chdir(tmp_path)
    assert says in refused(command, "--hand", hand)


@pytest.mark.parametrize("command", ["run", "bench", "simulate"])
def test_a_negative_seed_is_refused(command: str) -> None:
    assert "'--seed'" in refused(command, "--seed", "-1")
