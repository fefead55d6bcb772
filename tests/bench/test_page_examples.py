"""The worked examples of the two commands that need a running bench page; the others: tests/unit/cli."""

from __future__ import annotations

import shlex

import pytest
from typer.testing import CliRunner

from tests.bench.conftest import Server
from tests.unit.cli.test_worked_examples import WITH_A_PAGE, example
from tools.cli.main import app

pytestmark = pytest.mark.timeout(300)


def test_this_server_was_started_as_the_help_of_bench_says(server: Server) -> None:
    """With another port: 8750 may be taken."""
    words = shlex.split(example("bench"))
    assert isinstance(server.process.args, list)
    assert words == ["bench", "--port", words[2]]
    assert server.process.args[3:5] == words[:2]
    assert server.state()["phase"] in ("starting", "running")


def test_log_follow_prints_what_the_page_says(server: Server) -> None:
    server.wait_running()
    assert WITH_A_PAGE == ("bench", "log")
    done = CliRunner().invoke(app, [*shlex.split(example("log")), "--url", server.base, "--seconds", "2"])
    assert done.exit_code == 0, done.output
    assert "devices open" in done.stdout
