"""``docs/circle.md``: the whole circle, typed by a stranger in an empty folder."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tools.cli.main import app

PAGE = Path(__file__).parents[3] / "docs" / "circle.md"


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_circle_closes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    make, commands = re.findall(r"^``` \{[^\n]*\n(.*?)^```", PAGE.read_text(encoding="utf-8"), flags=re.S | re.M)
    exec(make, {})
    lines = commands.strip().splitlines()
    assert len(lines) == 7
    for line in lines:
        found = CliRunner().invoke(app, shlex.split(line)[1:])
        assert found.exit_code == 0, found.output
    alarm, changed, prospect, healed = (
        json.loads(Path(f"{n}.json").read_text()) for n in ("alarm", "changed", "prospect", "healed")
    )
    (departure,) = alarm["departures"]
    assert 60.0 <= departure["alarm_s"] <= 62.0
    assert any("hysteresis" in p["name"] for p in changed["physics"])
    assert prospect["shown"]
    assert [s["part"] for s in healed["steps"] if s["kept"]] == ["stacks"]
    assert healed["after"]["8-12 Hz"] < healed["before"]["8-12 Hz"]
    assert healed["after"]["2-500 Hz"] < healed["before"]["2-500 Hz"]
    assert Path("healed/tip.png").stat().st_size > 0
